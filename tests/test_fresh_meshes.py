"""The draw of meshes from packages: the same for everyone, and only of meshes."""

import zipfile

import numpy as np
import pytest
import trimesh

from benchmarks import fresh_meshes
from ginn_jax.errors import InputError
from ginn_jax.mesh import load_mesh


def as_file(mesh, kind):
    data = mesh.export(file_type=kind)
    return data if isinstance(data, bytes) else data.encode()


@pytest.fixture
def wheels(tmp_path):
    """Balls of growing size, and what must not be drawn."""
    balls = [trimesh.creation.icosphere(2, 1 + i) for i in range(8)]
    with zipfile.ZipFile(tmp_path / "a.whl", "w") as file:
        for i, ball in enumerate(balls[:5]):
            file.writestr(f"robosuite/b/ball_{i}.stl", as_file(ball, "stl"))
        file.writestr("robosuite/b/ball_1.obj", as_file(balls[1], "obj"))
        file.writestr("robosuite/c/b/ball_1.obj", as_file(balls[5], "obj"))
        file.writestr("robosuite/b/Ball_collision.stl", as_file(balls[0], "stl"))
        file.writestr("robosuite/b/box.stl", as_file(trimesh.creation.box(), "stl"))
        file.writestr("robosuite/b/broken.stl", b"solid" * 20)
        file.writestr("robosuite/b/notes.txt", b"no mesh")
    with zipfile.ZipFile(tmp_path / "b.whl", "w") as file:
        file.writestr("metaworld/ball.stl", as_file(balls[6], "stl"))
        file.writestr("elsewhere/ball.stl", as_file(balls[7], "stl"))
    return tmp_path


def draw(wheels, each):
    out = wheels / "out"
    made = fresh_meshes.main(fresh_meshes.Options(wheels, out, each))
    assert sorted(made) == sorted(out.iterdir())
    return [path.name for path in made]


def test_all_meshes_and_nothing_else_can_be_drawn(wheels):
    everything = {f"robosuite_b_ball_{i}.ply" for i in range(5)}
    found = draw(wheels, 99)
    (again,) = set(found) - everything - {"metaworld_metaworld_ball.ply"}
    assert again.startswith("robosuite_b_ball_1_")  # one more of that name
    assert set(found) == everything | {"metaworld_metaworld_ball.ply", again}
    assert len(found) == len(set(found))


def test_fewer_are_the_first_of_more(wheels):
    more = [name for name in draw(wheels, 4) if "robosuite" in name]
    for path in (wheels / "out").iterdir():
        path.unlink()
    assert [name for name in draw(wheels, 2) if "robosuite" in name] == more[:2]


def test_what_was_up_is_up(tmp_path):
    cone = load_mesh_of(tmp_path, trimesh.creation.cone(0.5, 3.0))
    fresh_meshes.keep(path := tmp_path / "cone.ply", cone)
    found = load_mesh(path)
    assert np.ptp(found.vertices, axis=0).round(4).tolist() == [1, 3, 1]
    apex = found.vertices[np.argmax(found.vertices[:, 1])]
    np.testing.assert_allclose(apex, [0, 3, 0], atol=1e-6)
    # Turned, not mirrored: faces still look outward.
    assert trimesh.load_mesh(path).volume > 0


def load_mesh_of(folder, mesh):
    mesh.export(folder / "mesh.ply")
    return load_mesh(folder / "mesh.ply")


def test_what_is_no_wheel_is_named(tmp_path):
    options = fresh_meshes.Options(tmp_path, tmp_path / "out")
    with pytest.raises(InputError, match="no wheels in it"):
        fresh_meshes.main(options)
    (tmp_path / "a.whl").write_bytes(b"half a wheel")
    with pytest.raises(InputError, match=r"a\.whl is damaged: download it again"):
        fresh_meshes.main(options)
