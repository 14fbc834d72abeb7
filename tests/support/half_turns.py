"""Half turns about an axis, implemented without the package's code that rotates
gaussians."""

import numpy as np

from v3dg import Gaussians

# The quaternion of a half turn, and the signs of the rotated gaussians' quaternions if
# their own axes are rotated, too.
_TURNS = {
    "x": ((0, 1, 0, 0), (1, 1, -1, -1)),
    "y": ((0, 0, 1, 0), (1, -1, 1, -1)),
    "z": ((0, 0, 0, 1), (1, -1, -1, 1)),
}


def half_turn(gaussians, axis):
    """Return the gaussians after half a turn about an axis of the world."""
    quaternion, signs = _TURNS[axis]
    moved = gaussians.transform(quaternion)
    return Gaussians(
        moved.means,
        gaussians.quats * np.array(signs, np.float32),
        gaussians.scales,
        gaussians.opacities,
        moved.sh,
    )
