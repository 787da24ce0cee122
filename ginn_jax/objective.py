"""What training minimises: the error of f_2D after f_3D on an example."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from ginn_jax.architecture import Network
from ginn_jax.example import Example
from ginn_jax.network import Encoder, Shader, Variables


def infer(
    network: Network, variables: Variables, example: Example, train: bool = False
) -> tuple[Float[Array, "M"], Variables]:
    """f_2D after f_3D, and the running moments of batch norm (changed if `train`)."""
    encoder, shader = Encoder(network, train), Shader(network, train)
    (code, moments_3d) = encoder.apply(
        variables["encoder"], *example.given, example.geometry, mutable=["batch_stats"]
    )
    (values, moments_2d) = shader.apply(
        variables["shader"],
        code,
        *example.asked,
        example.queries.mask,
        example.field,
        example.geometry.levels[0].mask,
        mutable=["batch_stats"],
    )
    return values, {"encoder": moments_3d, "shader": moments_2d}


def init_variables(
    network: Network, example: Example, *, key: Key[Array, ""]
) -> Variables:
    """Initial parameters and moments; `example` gives the shapes."""
    encoder_key, shader_key = jax.random.split(key)
    code, encoder = Encoder(network, True).init_with_output(
        encoder_key, *example.given, example.geometry
    )
    senders = example.geometry.levels[0].mask
    shader = Shader(network, True).init(
        shader_key, code, *example.asked, example.queries.mask, example.field, senders
    )
    return {"encoder": encoder, "shader": shader}


def batch_loss(
    params: Variables, moments: Variables, network: Network, example: Example
) -> tuple[Float[Array, ""], Variables]:
    """Mean squared error over the queries, the paper's L2 loss.

    Targets are in units of their cloud's mean light, so that bright clouds and suns
    weigh no more than others; an L2 loss keeps unbiased noisy targets unbiased.
    """
    variables = {part: params[part] | moments[part] for part in params}
    queries = example.queries
    values, moments = infer(network, variables, example, train=True)
    squared = jnp.where(queries.mask, (values - example.target) ** 2, 0.0)
    count = jnp.sum(queries.mask, dtype=jnp.float32)
    return jnp.sum(squared) / jnp.maximum(count, 1.0), moments


def split_variables(variables: Variables) -> tuple[Variables, Variables]:
    """Parameters, which are trained, and moments, which are tracked."""
    params = {part: {"params": v["params"]} for part, v in variables.items()}
    moments = {
        part: {name: v[name] for name in v if name != "params"}
        for part, v in variables.items()
    }
    return params, moments
