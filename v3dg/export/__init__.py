"""Bundles and scenes for the viewers of other programs: a module a format (docs/formats.md)."""

from v3dg.export._common import Axis as Axis
from v3dg.export.site import SITE_NEEDS as SITE_NEEDS
from v3dg.export.site import Site as Site
from v3dg.export.site import write_site as write_site
from v3dg.export.streamed_sog import DEFAULT_CHUNK as DEFAULT_CHUNK
from v3dg.export.streamed_sog import INDEX as INDEX
from v3dg.export.streamed_sog import Export as Export
from v3dg.export.streamed_sog import write_streamed_sog as write_streamed_sog
from v3dg.export.tiles import CESIUM as CESIUM
from v3dg.export.tiles import TILES_NEED as TILES_NEED
from v3dg.export.tiles import Tiles as Tiles
from v3dg.export.tiles import write_tiles as write_tiles
from v3dg.export.usd import write_usd as write_usd
