"""How many gaussians are refined together, and the memory that this takes."""

from v3dg.gaussians import gaussian_bytes

# Largest number of gaussians of level 0 in a unit: few faces between units, and little
# memory. The bits of a refined bundle depend on this number and on the next one.
UNIT_LEAVES = 1 << 22
# Memory that a unit may take, of the host and of a GPU, in bytes.
_UNIT_BYTES = 10_000_000_000
# A refinement needs memory for this many copies of all levels. All levels together have
# about twice as many gaussians as the asset.
_COPIES = 6


def most_leaves(sh_degree: int) -> int:
    """Return the largest number of gaussians of level 0 that are refined together."""
    num_leaves = UNIT_LEAVES
    while num_leaves > 1 and _bytes_of(num_leaves, sh_degree) > _UNIT_BYTES:
        num_leaves //= 2
    return num_leaves


def num_units(num_gaussians: int, sh_degree: int) -> int:
    """Return in how many units an asset is refined. Each has half of the gaussians of a
    larger subtree."""
    units = 1
    while -(-num_gaussians // units) > most_leaves(sh_degree):
        units *= 2
    return units


def unit_leaves(num_gaussians: int, sh_degree: int) -> int:
    """Return the number of gaussians of the asset in its largest unit."""
    return -(-num_gaussians // num_units(num_gaussians, sh_degree))


def refine_bytes(num_gaussians: int, sh_degree: int) -> int:
    """Return the memory, in bytes, that the refinement of an asset needs: of the host,
    and as much of a GPU."""
    return _bytes_of(unit_leaves(num_gaussians, sh_degree), sh_degree)


def _bytes_of(num_leaves: int, sh_degree: int) -> int:
    return 2 * _COPIES * num_leaves * gaussian_bytes(sh_degree)
