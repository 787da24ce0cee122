"""The network as a table of layers: Python numbers only, hashable, static under jit."""

from dataclasses import dataclass
from typing import Literal

from ginn_jax.checks import number, one_of, positive, whole
from ginn_jax.errors import InputError

QUERY = -1
WIDEST = 4096
# Layers and searches that are no convolution's.
TAKEN = ("latent", "latent_light", "area", "facets")


@dataclass(frozen=True)
class Conv:
    """One Monte Carlo convolution and the 1x1 layer before it.

    `before` says what happens to its input: "raw" nothing; "norm" normalise and
    activate; "dense" the same, then a 1x1 layer to `channels`, then the same again;
    "lift" a 1x1 layer to `channels`, then normalise and activate. A convolution that
    `mixes` has a kernel for every pair of input and output channels, the others one for
    each channel. `channels` is the width after "dense" or "lift", or what a convolution
    that `mixes` puts out; otherwise the input's width is kept. `bandwidth`, in radii,
    is that of the density estimate "kde". `skip` names the convolution whose output
    (with its own skip) is concatenated in front.
    """

    name: str
    source: int
    target: int
    radius: float
    bandwidth: float
    channels: int
    before: Literal["raw", "norm", "dense", "lift"] = "dense"
    mixes: bool = False
    skip: str | None = None

    def __post_init__(self) -> None:
        positive(f"radius of {self.name}", self.radius)
        positive(f"bandwidth of {self.name}", self.bandwidth)
        whole(f"channels of {self.name}", self.channels, 1, WIDEST)
        one_of(f"before of {self.name}", self.before, ("raw", "norm", "dense", "lift"))


def reach(radius: float, taper: float) -> float:
    """How far a receptive field that tapers reaches: see `receptive_field.window`."""
    return radius * (1 + taper) ** 0.5


@dataclass(frozen=True)
class Network:
    """f_3D and f_2D. Radii are in units of the object's longest side.

    levels      Poisson disk radii of the hierarchy, finest first
    encoder     the convolutions of f_3D, in order
    latent      channels of the code per point that f_3D hands to f_2D
    query       the one convolution of f_2D, from level 0 to the queries
    head        width of the layer between that convolution and the output
    hidden      width of the kernel perceptrons
    group       kernel values per perceptron: the paper's blocks; 0 for one shared block
    oriented    whether kernels see normals beside offsets
    sided       whether surfaces that face away from each other are apart, however near:
                Poisson disks and areas are then of one side of a thin wall
    density     how senders are weighted, see `receptive_field`
    norm        "batch" with running moments, "layer" over channels, or "none"
    materials   numbers of the material that a point comes with, such as its albedo
    lights      numbers of the light that a point comes with
    linear      whether light has features of its own on which nothing but linear maps
                act, so that the output is exactly linear in light
    local       whether the light at a query and near it also reaches the output on a
                linear path, scaled by features: normalised features forget magnitude
    beams       channels beside the features on which light passes all levels by linear
                maps alone, scaled by features: what an area sends on is a sum over it
    asks        what f_2D sees of a query: its "normal", or "all" its attributes
    splat       whether points are shaded, and their shading only blended at queries
    taper       width of the border in which receptive fields of f_3D fade out, in the
                square of the distance over the radius; 0: they end at it at once
    smooth      radius within which normals and light of finest points and queries are
                means over the samples around, see `facets`; 0: they are their own
    """

    levels: tuple[float, ...]
    encoder: tuple[Conv, ...]
    query: Conv
    latent: int
    head: int
    hidden: int = 16
    group: int = 0
    oriented: bool = True
    sided: bool = False
    density: Literal["kde", "surface"] = "surface"
    norm: Literal["batch", "layer", "none"] = "layer"
    materials: int = 0
    lights: int = 0
    linear: bool = False
    local: bool = False
    beams: int = 0
    asks: Literal["normal", "all"] = "normal"
    splat: bool = False
    taper: float = 0.0
    smooth: float = 0.0

    def __post_init__(self) -> None:
        """Raise `InputError` for what is no network, wherever it was read."""
        for radius in self.levels:
            positive("level", radius)
        if not self.levels or list(self.levels) != sorted(self.levels):
            raise InputError(f"levels {self.levels}: give at least one, finest first")
        for name, least in (("latent", 1), ("head", 1), ("hidden", 1), ("group", 0)):
            whole(name, getattr(self, name), least, WIDEST)
        for name in ("materials", "lights", "beams"):
            whole(name, getattr(self, name), 0, WIDEST)
        number("taper", self.taper, 0.0, 1.0)
        number("smooth", self.smooth, 0.0)
        one_of("density", self.density, ("kde", "surface"))
        one_of("norm", self.norm, ("batch", "layer", "none"))
        one_of("asks", self.asks, ("normal", "all"))
        self._check_light()
        self._check_chain()

    def _check_light(self) -> None:
        """Raise `InputError` for what light cannot do."""
        if self.splat and self.linear:
            raise InputError("a network that splats cannot be linear: choose one")
        if (self.linear or self.materials) and not self.lights:
            raise InputError("networks that are linear or take materials take light")
        if (self.local or self.beams) and not self.lights:
            raise InputError("a network without lights has none on a linear path")
        for conv in (*self.encoder, self.query):
            if conv.mixes and (self.linear or self.beams):
                raise InputError(f"{conv.name} mixes, but light passes it by itself")
        if self.query.mixes and self.local:
            raise InputError("f_2D mixes, but light near a query passes it by itself")

    def _check_chain(self) -> None:
        """Raise `InputError` unless each convolution begins where the last one ends."""
        level, targets = 0, dict[str, int]()
        within = {c.source for c in self.encoder if c.source == c.target}
        for conv in (*self.encoder, self.query):
            name, last = conv.name, conv is self.query
            if conv.source != level:
                raise InputError(
                    f"{name} begins on level {conv.source}, where the table has come "
                    f"to {level}: let each begin where the one before ends"
                )
            top = QUERY if last else len(self.levels) - 1
            whole(f"target of {name}", conv.target, QUERY if last else 0, top)
            if conv.skip is not None:
                alike = (n for n, target in targets.items() if target == conv.target)
                one_of(f"skip of {name}", conv.skip, tuple(alike))
            if name in targets:
                raise InputError(f"two convolutions are called {name}: rename one")
            if name in TAKEN or "." in name or name.startswith("level_"):
                raise InputError(f"no convolution can be called {name}: rename it")
            if self.density == "surface" and level > 0 and level not in within:
                raise InputError(f"no convolution within level {level} gives its areas")
            level = targets[name] = conv.target
        if self.query.source != 0:
            raise InputError("f_2D asks of level 0: let the encoder end there")
