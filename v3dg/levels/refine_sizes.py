"""How many gaussians are refined together, and the memory that this takes."""

from v3dg.gaussians import gaussian_bytes

# Largest number of gaussians of level 0 in a unit: so many that there are few faces
# between units, and so few that a unit needs little memory. The bits of a refined
# bundle depend on this number and on the next one.
UNIT_LEAVES = 1 << 22
# Memory that a unit may take on the host, and again on a GPU, in bytes.
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
    It needs as much again on a GPU."""
    return _bytes_of(unit_leaves(num_gaussians, sh_degree), sh_degree)


def _bytes_of(num_leaves: int, sh_degree: int) -> int:
    return 2 * _COPIES * num_leaves * gaussian_bytes(sh_degree)
