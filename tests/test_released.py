"""The authors' networks compute what their code says, written down once more.

The oracle has their names, their arrays as they lie in the checkpoint, and their sums
over all neighbours, in float64.
"""

import jax
import numpy as np
import pytest
from tensorflow_files import random_tensors, write_checkpoint

from benchmarks import released, released_network, released_weights
from benchmarks.released_network import Seen
from ginn_jax.errors import InputError
from ginn_jax.limits import Limits
from ginn_jax.lit_clouds import LitCloud
from ginn_jax.presets import RELEASED
from ginn_jax.searches import limit_names

# Blocks of 4 values, and rows and columns of the 1x1 layers.
CONVS = {"Pool_1": 4, "Conv_2": 4, "Pool_2": 8, "Conv_3": 8, "Pool_3": 16}
CONVS |= {"Conv_4": 16, "Up_3": 16, "Up_2": 8, "Up_1_2": 4, "Final_Conv": 2}
DENSE = {"Reduce_Pool_1": (8, 16), "Reduce_Conv_2": (16, 16)}
DENSE |= {"Reduce_Pool_2": (32, 32), "Reduce_Conv_3": (32, 32)}
DENSE |= {"Reduce_Pool_3": (64, 64), "Reduce_Conv_4": (64, 64)}
DENSE |= {"Up_3_Reduce": (128, 32), "Up_2_Reduce": (64, 16), "Up_1_Reduce": (24, 8)}
NORMS = {f"{n}_{end}": DENSE[n][end == "Out"] for n in DENSE for end in ("In", "Out")}
NORMS = {n: c for n, c in NORMS.items() if n.startswith("Reduce")}
NORMS |= {"Up_3": 64, "Up_3_Reduce": 128, "Up_2": 32, "Up_2_Reduce": 64}
NORMS |= {"Up_1_2": 16, "Up_1_Reduce": 24, "Up_1": 8}
NORMS |= {"Final_MLP1": 8, "Final_MLP2": 8}
GIVEN = {"gi": 5, "sss": 7}
ASKED = {"gi": 3, "sss": 7}


def random_weights(effect, seed=0):
    """A checkpoint of theirs: outputs that neither vanish nor explode."""
    convs = CONVS | {"Conv_1": 2 * GIVEN[effect]}
    dense = DENSE | {"Final_MLP1": (8 + ASKED[effect], 8), "Final_MLP2": (8, 1)}
    shapes = {}
    for name, blocks in convs.items():
        shapes |= {f"{name}_weights": (3, 4 * blocks), f"{name}_biases": (4 * blocks,)}
        for part in "23":
            shapes[f"{name}_weights{part}"] = blocks, 4, 4
            shapes[f"{name}_biases{part}"] = blocks, 4
    for name, shape in dense.items():
        shapes |= {f"{name}_weights": shape, f"{name}_biases": shape[1:]}
    for name, channels in NORMS.items():
        parts = ("gamma", "beta", "moving_mean", "moving_variance")
        shapes |= {f"{name}_BN_BN/{part}": (channels,) for part in parts}
    tensors = random_tensors(seed, shapes)
    for name, tensor in tensors.items():
        if name.endswith("variance"):
            tensor[:] = np.exp(tensor)
    return {f"feature_channel_scope/{n}": t for n, t in tensors.items()}


class Oracle:
    """Their code in NumPy."""

    def __init__(self, tensors):
        cut = len("feature_channel_scope/")
        self.t = {n[cut:]: np.float64(a) for n, a in tensors.items()}

    def norm(self, name, x):
        gamma, beta, mean, variance = (
            self.t[f"{name}_BN_BN/{part}"]
            for part in ("gamma", "beta", "moving_mean", "moving_variance")
        )
        x = gamma * (x - mean) / np.sqrt(variance + 1e-3) + beta
        return np.where(x > 0, x, 0.2 * x)

    def dense(self, name, x):
        return x @ self.t[f"{name}_weights"] + self.t[f"{name}_biases"]

    def reduced(self, name, x):
        return self.norm(f"{name}_Out", self.dense(name, self.norm(f"{name}_In", x)))

    def kernel(self, name, offset):
        rows = self.t[f"{name}_weights"].ravel().reshape(-1, 3)
        hidden = np.maximum(rows @ offset + self.t[f"{name}_biases"], 0)
        found = []
        for block in range(len(hidden) // 4):
            x = hidden[4 * block : 4 * block + 4]
            w2, b2, w3, b3 = (
                self.t[f"{name}_{part}"][block]
                for part in ("weights2", "biases2", "weights3", "biases3")
            )
            found.append(w3 @ np.maximum(w2 @ x + b2, 0) + b3)
        return np.concatenate(found)

    def conv(self, name, features, senders, receivers, radius, window, outputs=None):
        made = []
        for x in receivers:
            near = np.linalg.norm(senders - x, axis=1) < radius
            total = np.zeros(outputs or features.shape[1])
            for y, f in zip(senders[near], features[near], strict=True):
                apart = (senders[near] - y) / (radius * window)
                bell = np.exp(-0.5 * apart**2) / np.sqrt(2 * np.pi) / window
                density = np.prod(bell, axis=1).sum()  # times and by |N|
                values = self.kernel(name, (y - x) / radius)
                if outputs is None:
                    total += f * values / density
                else:
                    total += values.reshape(outputs, -1) @ f / density
            made.append(total)
        return np.array(made)

    def encode(self, levels, features):
        p0, p1, p2, p3 = levels
        conv1 = self.conv("Conv_1", features, p0, p0, 0.025, 0.25, 8)
        x = self.reduced("Reduce_Pool_1", conv1)
        pool1 = self.conv("Pool_1", x, p0, p1, 0.05, 0.2)
        x = self.reduced("Reduce_Conv_2", pool1)
        x = self.conv("Conv_2", x, p1, p1, 0.1, 0.25)
        conv2 = np.hstack([pool1, x])
        x = self.reduced("Reduce_Pool_2", conv2)
        pool2 = self.conv("Pool_2", x, p1, p2, 0.2, 0.2)
        x = self.reduced("Reduce_Conv_3", pool2)
        x = self.conv("Conv_3", x, p2, p2, 0.2, 0.25)
        conv3 = np.hstack([pool2, x])
        x = self.reduced("Reduce_Pool_3", conv3)
        x = self.conv("Pool_3", x, p2, p3, 0.4, 0.2)
        x = self.reduced("Reduce_Conv_4", x)
        x = self.conv("Conv_4", x, p3, p3, 1.0, 0.2)
        x = self.conv("Up_3", self.norm("Up_3", x), p3, p2, 0.4, 0.2)
        x = self.norm("Up_3_Reduce", np.hstack([conv3, x]))
        x = self.norm("Up_2", self.dense("Up_3_Reduce", x))
        x = self.conv("Up_2", x, p2, p1, 0.2, 0.2)
        x = self.norm("Up_2_Reduce", np.hstack([conv2, x]))
        x = self.norm("Up_1_2", self.dense("Up_2_Reduce", x))
        x = self.conv("Up_1_2", x, p1, p0, 0.1, 0.2)
        x = self.norm("Up_1_Reduce", np.hstack([conv1, x]))
        return self.norm("Up_1", self.dense("Up_1_Reduce", x))

    def shade(self, codes, points, queries, attributes):
        x = self.conv("Final_Conv", codes, points, queries, 0.05, 0.2)
        x = np.hstack([self.norm("Final_MLP1", x), attributes])
        x = self.norm("Final_MLP2", self.dense("Final_MLP1", x))
        return self.dense("Final_MLP2", x)[:, 0]


def lit_cloud(count, seed):
    """Some of a curved sheet, a hand wide."""
    rng = np.random.default_rng(seed)
    x, z = rng.uniform(-0.12, 0.12, (2, count))
    normal = np.stack([-4 * x, np.ones(count), 2 * z], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    position = np.stack([x, 2 * x**2 - z**2, z], axis=1)
    light = rng.uniform(0.5, 2, (count, 3))
    columns = position, normal, light, light, light
    position, normal, *lights = (np.float32(c) for c in columns)
    material = np.asarray(x > 0, np.int32)
    albedo = rng.uniform(0.2, 0.8, (2, 3)).astype(np.float32)
    return LitCloud(position, normal, material, *lights, albedo, np.zeros(0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trained_networks")
    for effect in GIVEN:
        write_checkpoint(folder / f"{effect}.ckpt", random_weights(effect))
    return folder


@pytest.mark.usefixtures("cheap_compiling")
def test_network_computes_what_their_code_says(folder):
    """Two colours of all at two exposures, which one call computes."""
    given, asked = lit_cloud(400, 1), lit_cloud(40, 2)
    variables = released_weights.load_released("gi", folder)
    seens = [Seen(1.5), Seen(0.5)]
    sizes = {n: 512 if "points" in n else 1 << 14 for n in limit_names(RELEASED)}
    deep, limits = released_network.encode_released(
        Limits(tuple(sizes.items())), variables, given, seens, key=jax.random.key(0)
    )
    ends = limits, variables, deep, asked, seens
    values, _ = released_network.shade_released("gi", *ends)
    kept = np.asarray(deep.encoded.kept)[:, : len(given.position)]
    rows = [np.flatnonzero(level) for level in kept]
    assert len(rows[0]) > 100 > len(rows[1]) > len(rows[2]) > len(rows[3]) > 0
    place = given.position.astype(np.float64)
    oracle = Oracle(random_weights("gi"))
    for number, seen, color in ((0, seens[0], 2), (1, seens[1], 0)):
        unit = given.irradiance[:, color].mean() / seen.exposure
        light = given.irradiance[:, [color]] / unit
        albedo = given.albedo[given.material][:, [color]]
        seen_there = np.hstack([given.normal, light, albedo])[rows[0]]
        codes = oracle.encode([place[r] for r in rows], np.float64(seen_there))
        right = oracle.shade(codes, place[rows[0]], asked.position, asked.normal)
        found = values[:, number, color] / unit
        assert np.abs(found - right).max() < 2e-4 * np.abs(right).max()


def test_what_they_see_of_a_medium():
    cloud = lit_cloud(30, 3)._replace(medium=np.array([20.0, 1.3]))
    units = np.array([[2.0, 1.0, 0.0]])  # nothing blue
    seen = released_network.attributes(cloud, units, [Seen(1.0, 0.1)])
    light = [[0.5], [1], [1]] * cloud.irradiance.T
    np.testing.assert_allclose(seen[..., 0], light, rtol=1e-6)
    np.testing.assert_array_equal(seen[..., 1], cloud.albedo[cloud.material].T)
    np.testing.assert_allclose(seen[..., 2:], np.broadcast_to([2, 1.3], (3, 30, 2)))


def test_all_their_weights_are_taken(folder):
    for effect in GIVEN:
        found = released_weights.load_released(effect, folder)
        weights = np.concatenate([np.ravel(a) for a in jax.tree.leaves(found)])
        theirs = np.concatenate([t.ravel() for t in random_weights(effect).values()])
        np.testing.assert_array_equal(np.sort(abs(weights)), np.sort(abs(theirs)))


def test_another_network_is_refused(tmp_path):
    write_checkpoint(tmp_path / "gi.ckpt", random_weights("sss"))
    layer = r"gi\.ckpt is of other layers: encoder\.params\.conv_1\.kernel"
    with pytest.raises(InputError, match=layer):
        released_weights.load_released("gi", tmp_path)
    write_checkpoint(tmp_path / "gi.ckpt", {"some": np.zeros(3, "f4")})
    with pytest.raises(InputError, match=r"other layers: 'Conv_1_weights'"):
        released_weights.load_released("gi", tmp_path)


def test_errors_of_a_level_that_is_off():
    cloud = lit_cloud(500, 4)
    target = np.random.default_rng(0).gamma(1.0, size=(500, 3)).astype(np.float32)
    cloud = cloud._replace(target=target, variance=0 * target)
    units = target.mean(axis=0)
    row = released.point_errors(units, cloud, 0.5 * target)
    assert row["level"] == pytest.approx(2.0, rel=1e-6)
    assert row["mse_3d_level"] == pytest.approx(0.0, abs=1e-10)
    assert row["correlation"] == pytest.approx(1.0)
    assert row["mse_3d"] == pytest.approx(np.mean((0.5 * target / units) ** 2))
    rows = [{"name": "a", "ray_variance": 1.0} | row] * 2
    assert released.summary("x", rows)["relative_mse_3d_level"] == pytest.approx(0)
