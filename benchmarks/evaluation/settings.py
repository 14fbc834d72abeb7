"""All sizes of the evaluation, for each preset."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Settings:
    """The sizes that define the amount of work of an evaluation.

    Attributes:
        asset_gaussians: Number of gaussians of the main scene's asset, if the asset is
            generated.
        instances: Number of instances in the main scene.
        worlds: Number of instances, and of gaussians per asset, of the other composed
            worlds.
        world_steps: Number of steps of the fit for the assets of `worlds`.
        size: Width and height of pictures in px.
        elevations: Elevations of the cameras of "composed" in degrees; other parts use
            the middle one.
        directions: Number of directions in "composed". The paper has four.
        distances: Number of cameras per direction in "composed", and in "large".
        sweep_distances: Number of cameras in the sweep that the other parts use.
        judged_directions: Number of directions for which FLIP is computed, which takes
            a second per picture.
        repeats: Number of timed calls per picture; the median counts.
        composed_repeats: Number of timed calls per picture in "composed", which has by
            far the most views.
        steps: Numbers of steps of the fit in "fit" and "levels". These parts also
            measure the paper's variant \\*0, whose gaussians are neither grown nor
            fitted.
        tree_steps: Number of steps of the fit in "tree".
        large_copies: Number of copies of the asset in the large asset.
        large_steps: Number of steps of the fit of the large asset.
        motion_frames: Number of frames of the zoom.
        hierarchy_instances: Number of instances in the scene that is compared with a
            hierarchy of single gaussians.
        hard_gaussians: Number of gaussians of each hard asset.
        counts: Numbers of gaussians for which single operations are measured.
        close_views: Number of directions of the close views of an asset.
        close_px: Width and height of the close views in px.
        panel: Width and height in px of the saved pictures.
    """

    asset_gaussians: int
    instances: int
    worlds: dict[str, tuple[int, int]]
    world_steps: int
    size: tuple[int, int]
    elevations: tuple[float, ...]
    directions: int
    distances: int
    sweep_distances: int
    judged_directions: int
    repeats: int
    composed_repeats: int
    steps: tuple[int, ...]
    tree_steps: int
    large_copies: int
    large_steps: int
    motion_frames: int
    hierarchy_instances: int
    hard_gaussians: int
    counts: tuple[int, ...]
    close_views: int
    close_px: int
    panel: int


PRESETS = {
    "small": Settings(
        asset_gaussians=16_500,
        instances=100,
        worlds={"forest": (80, 6_000), "temples": (30, 8_000), "crowd": (100, 2_000)},
        world_steps=80,
        size=(320, 180),
        elevations=(45.0,),
        directions=1,
        distances=4,
        sweep_distances=3,
        judged_directions=1,
        repeats=3,
        composed_repeats=3,
        steps=(0, 40, 160),
        tree_steps=40,
        large_copies=3,
        large_steps=40,
        motion_frames=6,
        hierarchy_instances=30,
        hard_gaussians=8_000,
        counts=(10_000, 100_000),
        close_views=2,
        close_px=400,
        panel=180,
    ),
    "full": Settings(
        asset_gaussians=45_000,
        instances=2048,
        worlds={"forest": (400, 315_630), "temples": (100, 1_350_487), "crowd": (400, 343_274)},
        world_steps=800,
        size=(1920, 1080),
        elevations=(15.0, 30.0, 45.0, 60.0, 75.0),
        directions=4,
        distances=20,
        sweep_distances=10,
        judged_directions=1,
        repeats=5,
        composed_repeats=3,
        steps=(0, 40, 160, 640),
        tree_steps=640,
        large_copies=225,
        large_steps=800,
        motion_frames=48,
        hierarchy_instances=128,
        hard_gaussians=200_000,
        counts=(10_000, 100_000, 1_000_000, 10_000_000, 100_000_000),
        close_views=8,
        close_px=800,
        panel=480,
    ),
}
