"""Slow float64 references, written from the definitions; no code of the library."""

import math

import numpy as np


def distance(a, b):
    return math.sqrt(sum((float(x) - float(y)) ** 2 for x, y in zip(a, b, strict=True)))


def neighbors(points, queries, radius):
    """(query, point) of all pairs closer than the radius, by query, then point."""
    return [
        (i, j)
        for i, query in enumerate(queries)
        for j, point in enumerate(points)
        if sum((float(q) - float(p)) ** 2 for q, p in zip(query, point, strict=True))
        < float(radius) ** 2
    ]


def dart_throwing(points, radius, lots, normals=None):
    """Throw points in order of their lots; each stays unless an earlier one is near.

    Given normals, what faces the other way is never near.
    """

    def near(i, k):
        if normals is not None and float(np.dot(normals[i], normals[k])) < 0:
            return False
        return distance(points[i], points[k]) < radius

    kept = []
    for i in sorted(range(len(points)), key=lambda i: (int(lots[i]), i)):
        if not any(near(i, k) for k in kept):
            kept.append(i)
    return sorted(kept)


def gaussian_density(point, samples, width):
    """Average of normalised three-dimensional Gaussians around the samples."""
    norm = (2 * math.pi * width**2) ** 1.5
    values = [
        math.exp(-0.5 * (distance(point, s) / width) ** 2) / norm for s in samples
    ]
    return sum(values) / len(values)


def quartic_area(point, samples, radius):
    """pi r^2 / 3 over the sum of (1 - d^2 / r^2)^2 of all samples within r."""
    values = [(1 - (distance(point, s) / radius) ** 2) ** 2 for s in samples]
    near = [
        v for v, s in zip(values, samples, strict=True) if distance(point, s) < radius
    ]
    return math.pi * radius**2 / 3 / sum(near) if near else math.nan


def perceptron(kernel, inputs):
    """All blocks of a kernel at one input, one number after the other."""
    w1, b1, w2, b2, w3, b3 = (np.asarray(a, np.float64) for a in kernel)
    values = []
    for g in range(len(w1)):
        layer = [max(b + inputs @ w1[g][:, i], 0.0) for i, b in enumerate(b1[g])]
        layer = [max(b + layer @ w2[g][:, i], 0.0) for i, b in enumerate(b2[g])]
        values += [b + layer @ w3[g][:, i] for i, b in enumerate(b3[g])]
    return values


def edge_inputs(x, y, radius, normal_x=None, normal_y=None):
    """(x - y) / r and, with normals, the products of normals and offset."""
    o = (np.asarray(x, np.float64) - np.asarray(y, np.float64)) / radius
    if normal_x is None:
        return o
    return np.array([*o, normal_x @ o, normal_y @ o, normal_x @ normal_y, o @ o])


class Surface:
    """Density of senders by the area each stands for, relative to the field's disk."""

    def __init__(self, points, real, radius):
        senders, disk = points[real], math.pi * radius**2
        self.share = [quartic_area(p, senders, radius) / disk for p in points]

    def __call__(self, j, near):
        return 1 / (self.share[j] * len(near))


class Gaussian:
    """The paper's density of senders, of bandwidth `h` in units of the radius."""

    def __init__(self, points, radius, h):
        self.points, self.h = np.asarray(points, np.float64) / radius, h

    def __call__(self, j, near):
        return gaussian_density(self.points[j], self.points[near], self.h)


def convolve(density, kernel, features, inputs, near, mix):
    """1/|N| sum_j f_j g(inputs_j) / p(y_j | x) at one receiver.

    `near` are its neighbours, `inputs` what the kernel sees of each. `mix(g, f)`
    applies a row of kernel values to a row of features.
    """
    terms = [
        np.asarray(mix(perceptron(kernel, i), features[j])) / density(j, near)
        for i, j in zip(inputs, near, strict=True)
    ]
    return sum(terms) / len(near) if near else 0.0


def depth_wise(values, features):
    """Kernel value c times channel c; values beyond the channels are unused."""
    return [v * f for v, f in zip(values, features, strict=False)]


def mixing(outputs):
    """Output k is the sum over channels c of value k * C + c times channel c."""

    def mix(values, features):
        width = len(features)
        rows = [values[k * width : (k + 1) * width] for k in range(outputs)]
        return [sum(depth_wise(row, features)) for row in rows]

    return mix
