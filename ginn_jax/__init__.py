"""Learned light transport on point clouds, in JAX.

A scene becomes a point cloud, an encoder-decoder of Monte Carlo convolutions (f_3D)
turns geometry, material and direct light into a latent code per point, and one
learned 3D-to-2D convolution (f_2D) carries it to every pixel of a G-buffer.
After "Deep-learning the Latent Space of Light Transport" (EGSR 2019).

Modules, in the order the data flows; each imports only what stands before it:

    errors            the exception for mistakes in the user's input
    checks            what public functions ask of their arguments
    files             checked before they are read, written whole or not
    process           settings of a process that make XLA faster on CPU
    commandline       options, one-line errors and exit codes of scripts
    orientation, mesh_files, mesh    triangles: loading, mending, ground
    outlying          points far from all others, set apart
    samples           points on surfaces, drawn from a mesh or read from a scan
    sdf, solids, *_shapes, shapes    the seeded source of procedural objects
    camera            pinhole cameras
    libllvm, renderer the ray tracer and its compiler, found and loaded
    draws             random numbers of rays
    reference         ambient occlusion and G-buffers by ray tracing
    visible           samples of the surface that light can reach
    radiance_files    what the renderer does not check of a map's file
    lighting          environment maps, procedural skies and studios, point lights
    estimates         rays dealt out to lanes, their mean and variance
    irradiance        direct and indirect irradiance by path tracing
    slab              albedo of a thick slab of a medium, and its inverse
    subsurface        radiant exitance by random walks in a medium
    objects           where objects and lights come from
    pairing           which of them go together, and what for
    ranges            ranges of rows expanded to lists, tile by tile
    voxels            points sorted by voxel, found by binary search under jit
    candidates        points that packets of queries may be near
    packets           radius search by packets of queries under jit
    pairs             what a search on the host found: decided, joined, in order
    neighbors         radius search on the host: exact, sizes itself
    hierarchy         Poisson disk sampling
    receptive_field   what an edge shows a kernel, what its sender weighs
    density           the paper's weights, by every pair of neighbours
    kernels           perceptrons from what an edge shows to kernel values
    mcconv            Monte Carlo convolution, tile by tile
    dataset           shaded points: one type for a cloud and for a G-buffer
    lit_clouds        clouds in colour on disk, and one channel of them
    lit_scenes        scenes with materials and a light; global illumination, scattering
    scenes            from objects to clouds with ground truth, in worker processes
    architecture      the network as a table of layers
    presets           the tables: ours, the paper's, the authors', ablations
    limits            capacities of all searches, and what they needed
    searches          which searches a network makes, and their capacities' names
    facets            normals and light as means over the samples around
    levels            Poisson disks one of the other, kept from frame to frame
    geometry          edges and weights of a cloud; demands
    network           f_3D and f_2D
    example           what a training step computes before any parameter enters
    objective         what training minimises
    recipe            how to train: sizes, schedule, optimiser
    train             one jitted step: geometry, gradient, update
    room              capacities of the steps of a run: the usual, and the most
    run_record        what made a run, as JSON: settings and capacities
    checkpoint        saving, resuming, loading weights
    fit               the training loop of a run
    shading           f_3D of a cloud and f_2D of queries, in every colour channel
    disk_radius       a trained network on finer or coarser points
    upsample          shading at a lower rate, guided by the G-buffer
    blocks            points padded, queries in blocks for all devices
    block_shading     f_2D by JAX, block after block
    cells             points by cell, as loops go through them
    lanes             points and programs in Dr.Jit's memory, a query in every lane
    lane_loops        loops over the points near a query
    lane_layers       layers of a row in a lane
    lane_fields       sums over the points around: convolutions, areas, facets
    lane_disks        Poisson disks, a sample in every lane
    lane_rows         layers of f_3D that take a point at a time
    lane_convolutions convolutions of f_3D with the layers between
    lane_encoding     f_3D in lanes, on a CPU
    lane_shading      f_2D in lanes, on a CPU
    given             whether weights, codes, points and queries are of a network
    inference         f_3D of a cloud once, f_2D at any points, sized by themselves
    image             from a G-buffer to an image
    plans             what no light changes of f_3D and f_2D, and the rest
    relight           what does not depend on the light, kept for any light
    screen            what methods that see only the G-buffer share: its coordinates
    screen_slices     the directions round a pixel in planes through the eye
    screen_sectors    what a pixel sees round itself, by slices and sectors
    screen_occlusion  ambient occlusion from the screen alone
    screen_bounce     one bounce of light from the screen alone
    screen_scattering subsurface scattering from the screen alone
    metrics           errors, noise floors, equal ray counts
    evaluate          errors of ambient occlusion: points, images, against run time
    lit_views         lit scenes seen by a camera, and networks on them
    evaluate_light    the same for effects that carry light
    pretrained        the trained networks that come with the package
    compare           shots, and the errors of the pictures that methods make of them
    compare_networks  the networks: ours, its ablations and variants, other runs
    compare_pictures  what they make of a shot: pictures, errors, memory
    compare_light     our network with what its samples and direct light take
    compare_frames    the networks on the frames of an animation
    compare_screen    methods of screen space on a shot
    compare_tracing   references of shots, and tracing as a rival
    report            metrics.json, report.md and figures of an experiment
    experiment        what every experiment does around its effect
    compare_report    lost cells, Pareto front and report.md of a comparison
    compare_figures   its figures
    sequences         animated meshes, samples that move with them, flicker
    animation_report  flicker, strip, moving image and report.md of animations
    occlusion_report  report.md of the experiment of ambient occlusion
    lit_report        report.md of effects that carry light
    lit_options       what an experiment with light is told; its objects and lights
    lit_experiment    what the experiments of effects that carry light share

Shape letters: N source points, M queries, E edges, C channels, D kernel inputs,
L levels, B batch, V F mesh vertices and faces, H W image.

Light is linear RGB. Irradiance is what arrives at a surface, direct from the light or
indirect after at least one bounce, before the surface's albedo; radiant exitance is
what leaves. What is displayed is (direct + indirect) albedo / pi, or exitance / pi. A
network sees one channel, in units of the mean light of the cloud.

Units: lengths are in units of the longest side of the object's bounding box; the
object is centred, +y is up, and the ground lies at its lowest point, 1e-4 below that
of a mesh. Ambient occlusion is openness in [0, 1]: the cosine-weighted fraction of
rays that meet nothing within the occlusion radius; 1 is open. Offsets of a
convolution point from sender to receiver, (x - y) / r. Neighbours are strictly closer
than the radius.
Arrays are float32 and int32 unless a signature says otherwise.
"""
