"""Learned light transport on point clouds, in JAX.

A scene becomes a point cloud, an encoder-decoder of Monte Carlo convolutions (f_3D)
turns geometry, material and direct light into a latent code per point, and one
learned 3D-to-2D convolution (f_2D) carries it to every pixel of a G-buffer.
After "Deep-learning the Latent Space of Light Transport" (EGSR 2019).

Modules, in the order the data flows; each imports only what stands before it:

    mesh, shapes      triangles, procedural objects, surface samples
    reference         ground truth by ray tracing (the only module with a renderer)
    dataset           shaded points: one type for a cloud and for a G-buffer
    neighbors         fixed-capacity voxel hash, radius search
    hierarchy         Poisson disk sampling and its levels
    mcconv            receptive fields and Monte Carlo convolution
    network           f_3D and f_2D as a table of layers
    train             limits, one jitted step, predictions
    checkpoint        saving and resuming a training run
    image             from a mesh and a camera to a shaded image
    metrics           errors, noise floors, equal ray counts
    report            metrics.json, report.md and figures of an experiment

Shape letters: N source points, M queries, E edges, C channels, D kernel inputs,
L levels, B batch, V F mesh vertices and faces, H W image.

Units: lengths are in units of the longest side of the object's bounding box; the
object is centred, +y is up, and the ground touches its lowest point. Ambient
occlusion is openness in [0, 1]: the cosine-weighted fraction of rays that meet
nothing within the occlusion radius; 1 is open. Offsets of a convolution point from
sender to receiver, (x - y) / r. Neighbours are strictly closer than the radius.
Arrays are float32 and int32 unless a signature says otherwise.
"""
