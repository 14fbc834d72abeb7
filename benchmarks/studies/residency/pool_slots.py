"""Pools that store float32 rows in comparison with pools that store codes, for the same
quantised bundles. Frames of a flight alternate between the two pools.

A pool stores rows if a bundle of its scene is float32. To get such a pool, one of the
two scenes has an additional tiny bundle behind the camera.

    python -m benchmarks.studies.residency.pool_slots --bundle quantized.v3dg \\
        --side 13 --size 1920 1080 --device cuda
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import tyro

import v3dg
from benchmarks.evaluation import record
from benchmarks.studies.residency.measure import Config, Field, pixels, summary, timed, write_copies
from v3dg.donut import make_donut

ROUNDS = 3


def with_rows(field: Field) -> v3dg.Scene:
    """Return the scene of the field with an additional float32 bundle that no camera
    sees."""
    scene = Field(field.config, field.paths).scene
    tiny = v3dg.build_bundle(make_donut(1000), config=v3dg.BuildConfig(steps=1), device="cpu")
    scene.add(tiny, positions=(0.0, -1e4, 0.0))
    return scene


def main(config: Config) -> None:
    with TemporaryDirectory() as temporary:
        folder = config.folder or Path(temporary)
        folder.mkdir(exist_ok=True)
        field = Field(config, write_copies(config, folder))
        cameras = field.flight()
        scenes = {"rows": with_rows(field), "codes": field.scene}
        result: list[dict[str, Any]] = []
        for memory in config.pools or ("2GB",):
            pools = {
                kind: v3dg.Renderer(scene, device=config.device, memory=memory)
                for kind, scene in scenes.items()
            }
            for number in range(ROUNDS):
                settled = []
                for kind, renderer in pools.items():
                    renderer.settle(cameras[0], tolerance=config.tolerance)
                    frames = timed(config, renderer, cameras)
                    renderer.settle(cameras[-1], tolerance=config.tolerance)
                    settled.append(renderer.render(cameras[-1], tolerance=config.tolerance))
                    slots = renderer.pool_frame.core.status().num_slots
                    row = {"kind": kind, "memory": memory, "round": number, "slots": slots}
                    result.append(row | summary(frames))
                    print(result[-1], flush=True)
                one, other = settled
                if one.stats.tolerance == other.stats.tolerance:
                    np.testing.assert_array_equal(pixels(one), pixels(other))
        record.write(config.output, {"device": config.device, "rows": result}, config.device)


if __name__ == "__main__":
    main(tyro.cli(Config))
