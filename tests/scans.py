"""Point clouds with normals, as files."""


def write_points(path, rows, names=("x", "y", "z", "nx", "ny", "nz")):
    head = [f"element vertex {len(rows)}", *(f"property float {n}" for n in names)]
    body = [" ".join(f"{value:.9g}" for value in row) for row in rows]
    lines = ["ply", "format ascii 1.0", *head, "end_header", *body]
    path.write_text("\n".join(lines) + "\n")
    return path
