"""Decides how many gaussians are refined together, and how much memory this takes."""

from v3dg.gaussians import gaussian_bytes

# Maximum number of gaussians of level 0 in a unit. With larger units, there are fewer
# boundaries between them; smaller units need less memory. The bits of a refined bundle
# depend on this number and on the next one.
UNIT_LEAVES = 1 << 22
# Memory, in bytes, that a unit may use on the host. It may use the same amount again on
# a GPU.
_UNIT_BYTES = 10_000_000_000
# A refinement needs memory for this many copies of all levels. All levels together have
# about twice as many gaussians as the asset.
_COPIES = 6


def most_leaves(sh_degree: int) -> int:
    """Return the maximum number of gaussians of level 0 that are refined together."""
    num_leaves = UNIT_LEAVES
    while num_leaves > 1 and _bytes_of(num_leaves, sh_degree) > _UNIT_BYTES:
        num_leaves //= 2
    return num_leaves


def num_units(num_gaussians: int, sh_degree: int) -> int:
    """Return the number of units in which an asset is refined. Subtrees are halved
    until they are small enough to be units."""
    units = 1
    while -(-num_gaussians // units) > most_leaves(sh_degree):
        units *= 2
    return units


def unit_leaves(num_gaussians: int, sh_degree: int) -> int:
    """Return the number of gaussians of the asset in its largest unit."""
    return -(-num_gaussians // num_units(num_gaussians, sh_degree))


def refine_bytes(num_gaussians: int, sh_degree: int) -> int:
    """Return the memory, in bytes, that the refinement of an asset needs on the host.
    It needs the same amount again on a GPU."""
    return _bytes_of(unit_leaves(num_gaussians, sh_degree), sh_degree)


def _bytes_of(num_leaves: int, sh_degree: int) -> int:
    return 2 * _COPIES * num_leaves * gaussian_bytes(sh_degree)
