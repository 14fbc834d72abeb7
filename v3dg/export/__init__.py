"""Exports bundles and scenes for the viewers of other programs, with one module per
format (docs/formats.md)."""

from v3dg.export._folder import check_outside
from v3dg.export.site import SITE_NEEDS, Site, write_site
from v3dg.export.streamed_sog import DEFAULT_CHUNK, INDEX, Export, write_streamed_sog
from v3dg.export.tiles import CESIUM, TILES_NEED, Tiles, write_tiles
from v3dg.export.usd import write_usd
from v3dg.export.web_page import WebPage, write_web_page

__all__ = [
    "CESIUM",
    "DEFAULT_CHUNK",
    "INDEX",
    "SITE_NEEDS",
    "TILES_NEED",
    "Export",
    "Site",
    "Tiles",
    "WebPage",
]
__all__ += ["check_outside", "write_site", "write_streamed_sog", "write_tiles", "write_usd"]
__all__ += ["write_web_page"]
