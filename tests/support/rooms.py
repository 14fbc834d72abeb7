"""Small scenes that surround the viewer: rooms and streets."""

import numpy as np

import v3dg


def box(rng, low, high, density=100.0, sides="xXyYzZ"):
    """Return points that are evenly distributed on sides of a box. In `sides`, x is the
    low side across the x axis, and X the high one."""
    borders = np.array([low, high], float)
    points = []
    for side in sides:
        axis = "xyz".index(side.lower())
        side_axes = [number for number in range(3) if number != axis]
        count = int(density * np.prod((borders[1] - borders[0])[side_axes])) + 4
        of_side = rng.uniform(*borders, (count, 3))
        of_side[:, axis] = borders[int(side.isupper()), axis]
        points.append(of_side)
    return np.concatenate(points)


def asset_of(points, scale=0.06):
    count = len(points)
    rng = np.random.default_rng(count)
    return v3dg.Gaussians(
        np.ascontiguousarray(points, np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.full((count, 3), scale, np.float32),
        np.full(count, 0.95, np.float32),
        rng.uniform(-1, 1, (count, 1, 3)).astype(np.float32),
    )


def room(density=25.0):
    """Return walls, a table and a cupboard; -y is up."""
    rng = np.random.default_rng(0)
    walls = box(rng, (-3, -2.6, -2), (3, 0, 2), density)
    table = box(rng, (-0.8, -0.8, -0.5), (0.8, -0.7, 0.5), 4 * density)
    cupboard = box(rng, (-2.9, -2, -1.9), (-2.3, 0, 0), density)
    return asset_of(np.concatenate([walls, table, cupboard]), 0.6 * density**-0.5)


def house(density=25.0):
    """Return a room in a garden of twice its area."""
    rng = np.random.default_rng(1)
    garden = box(rng, (-4, 0, -4), (4, 0.05, 4), density, sides="y")
    rooms = room(density).means.astype(float)
    return asset_of(np.concatenate([rooms, garden]), 0.6 * density**-0.5)


def street(density=12.0):
    """Return two rows of houses with stalls in between, open above and at the ends."""
    rng = np.random.default_rng(2)
    points = [box(rng, (0, 0, -4), (30, 0.05, 4), density, sides="y")]
    for side in (-1, 1):
        for number in range(6):
            low = (5 * number, -6 - 2 * (number % 2), min(4 * side, 8 * side))
            high = (5 * number + 4.8, 0, max(4 * side, 8 * side))
            points.append(box(rng, low, high, density, sides="xXyzZ"))
    for number in range(8):
        x = 2 + 3.5 * number
        z = 2.6 * (-1) ** number
        points.append(box(rng, (x, -1.5, z - 0.4), (x + 1.5, 0, z + 0.4), density, "xXyzZ"))
    return asset_of(np.concatenate(points), 0.6 * density**-0.5)


def terrain(count=6000):
    rng = np.random.default_rng(3)
    x, z = rng.uniform(-10, 10, (2, count))
    y = -1.2 * np.sin(0.6 * x) * np.cos(0.5 * z)
    return asset_of(np.stack([x, y, z], axis=1), 20 * count**-0.5)
