"""Bundles: the clusters of all levels of one asset, with the tables that selection
reads, and their files."""

from v3dg.bundle.bundle import Bundle
from v3dg.bundle.tables import NESTING_MARGIN, Clusters, Groups

__all__ = ["NESTING_MARGIN", "Bundle", "Clusters", "Groups"]
