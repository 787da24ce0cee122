"""Meshes, points and maps that cannot be used.

`ROWS` is the table: what is wrong, how to make it, what is called with it, and what is
said.
"""

import numpy as np
from damaged import (
    BOX,
    NOISE,
    PLY,
    Row,
    assert_refused,
    directory,
    each_row,
    holds,
    missing,
    zeros,
)

from ginn_jax import lighting, mesh, samples
from ginn_jax.renderer import use_mitsuba

TEXT_PLY = BOX.export(file_type="ply", encoding="ascii")
STL = BOX.export(file_type="stl")
TRIANGLE = "v {} 0 0\nv 1 0 0\nv 0 1 0\nf {} 2 3\n"
POINTS = "ply\nformat ascii 1.0\nelement vertex {}\n" + "".join(
    f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz")
)
ONE_POINT = POINTS + "end_header\n0 0 0 0 1 0\n"
BAD_POINTS = "end_header\n0 0 0 0 1 0\n0 0 inf 0 1 0\n0 0 0 0 nan 0\n0 0 0 0 0 0\n"


def image(name, value, others=1.0):
    """A map with one pixel of this value."""

    def make(folder):
        pixels = np.full((4, 8, 3), others, np.float32)
        pixels[1, 2, 0] = value
        use_mitsuba()[0].Bitmap(pixels).write(str(folder / name))
        return folder / name

    return make


def cut(name, share):
    """The first part of a map."""

    def make(folder):
        pixels = np.random.default_rng(0).uniform(size=(32, 64, 3))
        use_mitsuba()[0].Bitmap(pixels.astype(np.float32)).write(str(folder / name))
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(whole[: int(share * len(whole))])
        return folder / name

    return make


def huge(header):
    """A map that says it is enormous."""
    return header.encode() + NOISE


MAP = lighting.load_environment
RGBE = "#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {0} +X {0}\n"
ROWS = [
    # Meshes
    Row("no file", missing("a.ply"), mesh.load_mesh, "no such file; give the path"),
    Row("a folder", directory("a.ply"), mesh.load_mesh, "no such file; give the path"),
    Row("long name", missing("a" * 300), mesh.load_mesh, "name too long; give the"),
    Row("line break in its name", missing("a\nb"), mesh.load_mesh, "a b: no such file"),
    Row("empty PLY", holds("", "a.ply"), mesh.load_mesh, "nothing in it"),
    Row("empty OBJ", holds("", "a.obj"), mesh.load_mesh, "nothing in it"),
    *(
        Row(f"1 GB of nothing, {name}", zeros(name), call, "nothing in it")
        for name, call in (
            ("a.ply", mesh.load_mesh),
            ("a.obj", mesh.load_mesh),
            ("a.stl", mesh.load_mesh),
            ("a.glb", mesh.load_mesh),
            ("p.ply", samples.load_points),
            ("a.hdr", MAP),
            ("a.exr", MAP),
        )
    ),
    Row("half a PLY", holds(PLY[:300], "a.ply"), mesh.load_mesh, "unexpected length"),
    Row("PLY without end", holds(PLY[:100], "a.ply"), mesh.load_mesh, "export it anew"),
    Row("half a text PLY", holds(TEXT_PLY[:-30], "a.ply"), mesh.load_mesh, "cut short"),
    Row("half an STL", holds(STL[:200], "a.stl"), mesh.load_mesh, "no triangles in it"),
    Row(
        "a PLY of 10^12 vertices",
        holds(PLY.replace(b"vertex 8", b"vertex 1000000000000"), "a.ply"),
        mesh.load_mesh,
        "unexpected length",
    ),
    *(
        Row(f"noise.{end}", holds(NOISE, f"a.{end}"), mesh.load_mesh, said)
        for end, said in (
            ("ply", "Not a ply"),
            ("obj", "no triangles in it"),
            ("stl", "no triangles in it"),
            ("off", "cannot be read"),
            ("glb", "incorrect header"),
            ("gltf", "cannot be read"),
            ("txt", "'txt' not supported"),
            ("npz", "'npz' not supported"),
        )
    ),
    Row(
        "GLB of version 0",
        holds(b"glTF\0\0\0\0", "a.glb"),
        mesh.load_mesh,
        "cannot be read .only GLTF 2 is supported",
    ),
    Row("PLY as OBJ", holds(PLY, "a.obj"), mesh.load_mesh, "no triangles in it"),
    Row("OBJ as PLY", holds(TRIANGLE, "a.ply"), mesh.load_mesh, "Not a ply"),
    Row(
        "no faces",
        holds("v 0 0 0\nv 1 0 0\n", "a.obj"),
        mesh.load_mesh,
        "use load_points",
    ),
    Row("no geometry", holds("{}", "a.gltf"), mesh.load_mesh, "no triangles in it"),
    *(
        Row(f"OBJ, {name}", holds(TRIANGLE.format(*v), "a.obj"), mesh.load_mesh, said)
        for name, v, said in (
            ("vertex NaN", ("nan", 1), "1 vertices are not finite; remove them"),
            ("vertex 1e39", ("1e39", 1), "1 vertices are not finite; remove them"),
            ("vertex word", ("word", 1), "cannot be read"),
            ("face 9", ("0", 9), "index 8 is out of bounds"),
            ("face 2 2 3", ("0", 2), "zero area; give triangles with an area"),
        )
    ),
    Row("no meshes", directory("none"), mesh.find_meshes, "no mesh in this folder"),
    Row("no folder", missing("gone"), mesh.find_meshes, "no such file or folder"),
    # Points
    Row(
        "no rows",
        holds(POINTS.format(0), "p.ply"),
        samples.load_points,
        "cannot be read .*; export it anew",
    ),
    Row(
        "5 rows, 1 there",
        holds(ONE_POINT.format(5), "p.ply"),
        samples.load_points,
        "cannot be read .cut short.; export it anew",
    ),
    Row(
        "no normals",
        holds(ONE_POINT.format(1).replace(" nx", " a"), "p.ply"),
        samples.load_points,
        "no normals; estimate them",
    ),
    Row(
        "zero normal",
        holds(ONE_POINT.format(1).replace("0 1 0\n", "0 0 0\n"), "p.ply"),
        samples.load_points,
        "zero normal; drop them",
    ),
    Row(
        "3 of 4 not finite or zero",
        holds(POINTS.format(4) + BAD_POINTS, "p.ply"),
        samples.load_points,
        "3 points have a non-finite value or a zero normal; drop them",
    ),
    Row("a mesh", holds(PLY, "p.ply"), samples.load_points, "a mesh, .* use load_mesh"),
    Row(
        "points as a mesh",
        holds(ONE_POINT.format(1), "p.ply"),
        mesh.load_mesh,
        "a point cloud, no triangles; use load_points",
    ),
    # Environment maps
    Row("no HDR", missing("a.hdr"), MAP, "no such file; give an environment map"),
    Row(
        "a folder for a map",
        directory("a.hdr"),
        MAP,
        "no such file; give an environment map",
    ),
    Row(
        "no maps, no folder",
        missing("gone"),
        lighting.find_environments,
        "no such file or folder; give environment maps",
    ),
    Row("no maps", directory("none"), lighting.find_environments, "no .hdr, .exr"),
    *(
        Row(f"{name} of {value}", image(name, value), MAP, said)
        for name in ("a.exr", "a.pfm")
        for value, said in (
            (np.nan, "not finite; mend those pixels"),
            (np.inf, "not finite; mend those pixels"),
            (-1e-3, "negative; clip it at zero"),
        )
    ),
    *(
        Row(
            f"black{end}",
            image(f"a{end}", 0.0, 0.0),
            MAP,
            "zero everywhere: the map is empty",
        )
        for end in lighting.ENDINGS
    ),
    *(
        Row(f"{share} of a map{end}", cut(f"a{end}", share), MAP, "cannot be read")
        for end in lighting.ENDINGS
        for share in (0.001, 0.1, 0.5, 0.99)
    ),
    *(
        Row(f"{name}, a{end}", holds(content, f"a{end}"), MAP, "cannot be read")
        for end in (*lighting.ENDINGS, ".txt", ".png", "")
        for name, content in (("empty", ""), ("words", "no image at all\n" * 20))
    ),
    Row("noise.hdr", holds(NOISE, "a.hdr"), MAP, "Unknown file format"),
    Row("PLY as HDR", holds(PLY, "a.hdr"), MAP, "Unknown file format"),
    Row(
        "enormous HDR", holds(huge(RGBE.format(10**6)), "a.hdr"), MAP, "cannot be read"
    ),
    Row("HDR of -8 rows", holds(huge(RGBE.format(-8)), "a.hdr"), MAP, "cannot be read"),
    Row(
        "enormous PFM",
        holds(huge("PF\n999999 999999\n-1\n"), "a.pfm"),
        MAP,
        "cannot be read",
    ),
]


@each_row(ROWS)
def test_bad_file_is_refused_in_one_line(row, tmp_path):
    assert_refused(row, tmp_path)
