"""Packs the add-on and the wheels that it needs into an archive that Blender installs.

    pip wheel --wheel-dir wheels v3dg
    python integrations/blender/pack.py v3dg_blender.zip wheels/*.whl

The wheels must be those for Blender's Python and operating system, so run this with
the same version of Python. NumPy is left out, because Blender contains it.
"""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path

FOLDER = Path(__file__).resolve().parent / "v3dg_blender"
MANIFEST = "blender_manifest.toml"
# Packages that Blender's Python has.
_IN_BLENDER = ("numpy-",)


def pack(archive: Path, wheels: list[Path]) -> None:
    """Write the archive.

    Raises:
        ValueError: A path is not a wheel.
    """
    for wheel in wheels:
        if wheel.suffix != ".whl" or not wheel.is_file():
            raise ValueError(f"{wheel}: expected the file of a wheel; make them with pip wheel")
    packed = [wheel for wheel in wheels if not wheel.name.startswith(_IN_BLENDER)]
    lines = [f'  "./wheels/{wheel.name}",' for wheel in packed]
    # In TOML, keys of the top level must come before the first table.
    manifest = (FOLDER / MANIFEST).read_text(encoding="utf-8")
    top, table, permissions = manifest.partition("[permissions]")
    listed = "\n".join(["wheels = [", *lines, "]", "", ""])
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(MANIFEST, top + listed + table + permissions)
        for source in sorted(FOLDER.glob("*.py")):
            file.write(source, source.name)
        for wheel in packed:
            file.write(wheel, f"wheels/{wheel.name}")


def main() -> None:
    if len(sys.argv) < 3:
        sys.exit("pack.py: expected an archive to write and wheels, got fewer arguments")
    try:
        pack(Path(sys.argv[1]), [Path(name) for name in sys.argv[2:]])
    except (OSError, ValueError) as error:
        sys.exit(f"pack.py: error: {error}")


if __name__ == "__main__":
    main()
