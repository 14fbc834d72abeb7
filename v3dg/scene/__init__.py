"""Scenes, which consist of instances of bundles, and their files."""

from v3dg.scene.scene import Scene as Scene
from v3dg.scene.scene import Subject as Subject
