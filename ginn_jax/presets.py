"""Layer tables: ours, the paper's, the authors', and what ablations leave of them."""

from dataclasses import replace

from ginn_jax.architecture import QUERY, Conv, Network


def released_table(k: int, radii: tuple[float, ...]) -> tuple[Conv, ...]:
    """The authors' eleven convolutions but the last, for four levels and base width k.

    `radii` are those of levels 1, 2, 3; receptive fields are twice as wide, within the
    last level 1.0, within level 2 as in the release.
    """
    fine, middle, coarse = radii
    return (
        Conv("conv_1", 0, 0, 0.025, 0.25, k, "raw", mixes=True),
        Conv("pool_1", 0, 1, fine, 0.2, 2 * k),
        Conv("conv_2", 1, 1, 2 * fine, 0.25, 2 * k, skip="pool_1"),
        Conv("pool_2", 1, 2, 2 * middle, 0.2, 4 * k),
        Conv("conv_3", 2, 2, 2 * middle, 0.25, 4 * k, skip="pool_2"),
        Conv("pool_3", 2, 3, 2 * coarse, 0.2, 8 * k),
        Conv("conv_4", 3, 3, 1.0, 0.2, 8 * k),
        Conv("up_3", 3, 2, 2 * coarse, 0.2, 8 * k, "norm", skip="conv_3"),
        Conv("up_2", 2, 1, 2 * middle, 0.2, 4 * k, skip="conv_2"),
        Conv("up_1", 1, 0, 2 * fine, 0.2, 2 * k, skip="conv_1"),
    )


RELEASED = Network(
    levels=(0.01, 0.05, 0.1, 0.2),
    encoder=released_table(8, (0.05, 0.1, 0.2)),
    query=Conv("query", 0, QUERY, 0.05, 0.2, 8, "raw"),
    latent=8,
    head=8,
    hidden=4,
    group=4,
    oriented=False,
    density="kde",
    norm="batch",
)


PAPER = replace(
    RELEASED,
    levels=(0.01, 0.05, 0.15, 0.5),
    encoder=released_table(8, (0.05, 0.15, 0.5)),
    hidden=8,
    group=8,
)


def compact_table(
    k: int, radii: tuple[float, ...], within: float, between: float
) -> tuple[Conv, ...]:
    """An encoder-decoder over any number of levels.

    Fields are `within` spacings wide inside a level and `between` spacings of the
    coarser level across two.
    """
    rows = [Conv("conv_0", 0, 0, within * radii[0], 0.25, k, "lift")]
    for level in range(1, len(radii)):
        field, width = radii[level], k << level
        pool = f"pool_{level}"
        rows += [
            Conv(pool, level - 1, level, between * field, 0.25, width),
            Conv(f"conv_{level}", level, level, within * field, 0.25, width, skip=pool),
        ]
    for level in range(len(radii) - 1, 0, -1):
        field, width = between * radii[level], k << (level - 1)
        skip = f"conv_{level - 1}"
        rows.append(
            Conv(f"up_{level}", level, level - 1, field, 0.25, width, skip=skip)
        )
    return tuple(rows)


def compact_network(
    k: int = 24,
    levels: tuple[float, ...] = (0.02, 0.05, 0.1),
    within: float = 2.5,
    between: float = 1.5,
    query_radius: float = 0.035,
    latent: int = 16,
    **more,
) -> Network:
    """Ours: shared oriented kernels, surface weights, few levels."""
    return Network(
        levels=levels,
        encoder=compact_table(k, levels, within, between),
        query=Conv("query", 0, QUERY, query_radius, 0.25, latent, "raw"),
        latent=latent,
        head=latent,
        **more,
    )


def only_2d(network: Network) -> Network:
    """Without f_3D: one 3D-to-2D convolution of raw attributes, wider and further.

    At half as far again as f_2D's own radius an image takes about the time that f_3D
    and f_2D take together.
    """
    query = replace(network.query, radius=round(1.5 * network.query.radius, 4))
    return replace(
        network,
        levels=network.levels[:1],
        encoder=(),
        query=query,
        latent=2 * network.latent,
    )


def only_3d(network: Network) -> Network:
    """Without a learned f_2D: f_3D shades points, and pixels blend those around."""
    return replace(network, splat=True)


def in_width(network: Network, factor: float) -> Network:
    """The same table with so many times the channels."""

    def scaled(conv: Conv) -> Conv:
        return replace(conv, channels=round(factor * conv.channels))

    return replace(
        network,
        encoder=tuple(map(scaled, network.encoder)),
        query=scaled(network.query),
        latent=round(factor * network.latent),
        head=round(factor * network.head),
    )


def with_ablations(network: Network) -> dict[str, Network]:
    """The paper's ablations of a network."""
    return {"only_2d": only_2d(network), "only_3d": only_3d(network)}


# Creases are dark over a hundredth of the object: finer points than light needs.
DEFAULT = compact_network(
    levels=(0.01, 0.03, 0.1), query_radius=0.02, sided=True, taper=0.45
)


PRESETS = {"default": DEFAULT, "paper": PAPER, "released": RELEASED}


PRESETS |= with_ablations(DEFAULT)


# Light goes further than occlusion, hence a level more.
_FAR = {"k": 16, "lights": 1}


_DIFFUSE = compact_network(
    levels=(0.02, 0.05, 0.1, 0.2), materials=1, taper=0.4, **_FAR
)


# Most media are dense: light leaves them near to where it entered.
_DENSE = compact_network(
    levels=(0.015, 0.04, 0.1, 0.2),
    query_radius=0.0275,
    sided=True,
    smooth=0.01,
    taper=0.4,
    **_FAR,
)


def for_light(network: Network) -> dict[str, Network]:
    """The presets of an effect that carries light; the first is its default."""
    return {
        "homogeneous": network,
        "linear": replace(network, linear=True, local=False, beams=0),
        "narrow": in_width(network, 0.5),
        "wide": in_width(network, 2.0),
        "released": replace(
            RELEASED,
            lights=1,
            materials=network.materials,
            asks=network.asks,
        ),
        **with_ablations(network),
    }


# The albedo of a point and what it sends out.
ILLUMINATION = for_light(_DIFFUSE)


# Albedo, extinction and index of refraction, and the irradiance.
SCATTERING = for_light(replace(_DENSE, materials=3, asks="all", local=True, beams=8))


DEFAULTS = {
    "ao": DEFAULT,
    "gi": ILLUMINATION["homogeneous"],
    "sss": SCATTERING["homogeneous"],
}


def effect_of(network: Network) -> str | None:
    """The effect whose networks take these numbers of material and light, if any."""
    taken = network.materials, network.lights
    for effect, default in DEFAULTS.items():
        if taken == (default.materials, default.lights):
            return effect
    return None
