"""Meshes of unit size, of which robots are put together."""

from collections.abc import Callable
from typing import Any

import numpy as np

_SIDES = 20  # of what is round
_STRAIGHT = 0.8  # of a pill's length


def _sphere() -> tuple[np.ndarray, np.ndarray]:
    return _turned(np.linspace(-np.pi / 2, np.pi / 2, _SIDES // 2 + 1))


def _turned(latitudes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns a unit sphere with corners at these latitudes."""
    longitudes = np.linspace(0, 2 * np.pi, _SIDES, endpoint=False)
    lat, lon = np.meshgrid(latitudes, longitudes, indexing="ij")
    rows = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
    return np.stack(rows, -1).reshape(-1, 3), _quads(len(latitudes))


def _pill() -> tuple[np.ndarray, np.ndarray]:
    """Returns a unit sphere that was drawn out: most of it is a cylinder."""
    latitudes = np.linspace(-np.pi / 2, np.pi / 2, _SIDES // 2 + 2)
    vertices, faces = _turned(latitudes)
    ends = np.sign(vertices[:, 2]) * (
        _STRAIGHT + (1 - _STRAIGHT) * np.abs(vertices[:, 2])
    )
    return np.column_stack([vertices[:, :2], ends]), faces


def _tube() -> tuple[np.ndarray, np.ndarray]:
    angles = np.linspace(0, 2 * np.pi, _SIDES, endpoint=False)
    ring = np.stack([np.cos(angles), np.sin(angles)], -1)
    ends = [np.column_stack([ring, np.full(_SIDES, z)]) for z in (-1.0, 1.0)]
    return np.concatenate(ends), _quads(2)


def _can() -> tuple[np.ndarray, np.ndarray]:
    """Returns a tube with lids, which have corners of their own for a sharp rim."""
    sides, faces = _tube()
    low, high = sides[:_SIDES], sides[_SIDES:]
    i = np.arange(1, _SIDES - 1)
    fan = np.column_stack([np.zeros_like(i), i, i + 1])
    lids = [fan[:, ::-1] + 2 * _SIDES, fan + 3 * _SIDES]
    return np.concatenate([sides, low, high]), np.concatenate([faces, *lids])


def _box() -> tuple[np.ndarray, np.ndarray]:
    """Returns a cube of half width one, whose sides share no corner."""
    vertices, faces = [], []
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    for axis in range(3):
        for sign in (-1.0, 1.0):
            side = np.insert(square, axis, sign, axis=1)
            start = 4 * len(vertices)
            # np.insert keeps the order of the other two axes; for y it is a mirror.
            is_outward = (sign > 0) != (axis == 1)
            order = [0, 1, 2, 0, 2, 3] if is_outward else [0, 2, 1, 0, 3, 2]
            faces += [start + np.array(order).reshape(2, 3)]
            vertices.append(side)
    return np.concatenate(vertices), np.concatenate(faces)


def _quads(rings: int) -> np.ndarray:
    """Returns the faces between rings of corners, seen from outside."""
    ring, i = np.meshgrid(np.arange(rings - 1), np.arange(_SIDES), indexing="ij")
    a, b = ring * _SIDES + i, ring * _SIDES + (i + 1) % _SIDES
    faces = [
        np.stack(x, -1).reshape(-1, 3)
        for x in ((a, b, b + _SIDES), (a, b + _SIDES, a + _SIDES))
    ]
    return np.concatenate(faces)


UNIT: dict[Any, Callable[[], tuple[np.ndarray, np.ndarray]]] = {
    "sphere": _sphere,
    "pill": _pill,
    "tube": _tube,
    "can": _can,
    "box": _box,
}
"""By name: vertices `[V, 3]`, and faces `[F, 3]` that are seen from outside."""
