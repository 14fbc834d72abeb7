"""Makes viewer_residency.jpg: the viewer just after a teleport, when pages are still
missing.

python docs/images/make_residency.py donut.v3dg FOLDER

The scene is a field of a hundred copies of the bundle, which are separate files in
FOLDER, as in `benchmarks.studies.residency`. The script needs playwright.
"""

import shutil
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from make_viewer import ARGUMENTS, save, settle, shot
from playwright.sync_api import sync_playwright

import v3dg
from v3dg.viewer.frame import Frame, SceneView
from v3dg.viewer.server import Site
from v3dg.viewer.view import View

# to import benchmarks/ of this checkout
sys.path.append(str(Path(__file__).resolve().parents[2]))
from benchmarks.studies.residency.measure import Config, Field, write_copies

WIDTH, HEIGHT, PANEL = 1120, 640, 300


class HeldView(SceneView):
    """A view that draws only the first picture from ``eye`` at full size, and no
    picture before or after it."""

    eye: np.ndarray | None = None
    last: Frame
    is_held = False

    def frame(self, view: View, size: tuple[int, int], *others: Any, **named: Any) -> Frame:
        while self.is_held:
            time.sleep(0.05)
        if self.eye is not None:
            if not np.allclose(view.position, self.eye, rtol=0, atol=1e-9):
                return self.last
            self.is_held, size = True, (WIDTH - PANEL, HEIGHT)
        self.last = super().frame(view, size, *others, **named)
        return self.last


def main(bundle: str, folder: str) -> None:
    Path(folder).mkdir(parents=True, exist_ok=True)
    config = Config(bundle=Path(bundle), side=10, size=(WIDTH - PANEL, HEIGHT))
    field = Field(config, write_copies(config, Path(folder)))
    far, near = (
        v3dg.Camera.look_at(eye, (4.5, 5, 0), fov_x=1.0, width=WIDTH - PANEL, height=HEIGHT)
        for eye in ((4.5, -9, 6.5), (4.5, -2.5, 2.6))
    )
    view = HeldView(field.scene, device="cpu", memory="1GB")
    site = Site(view, name="field", cameras={"far": far, "near": near}, port=0)
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.goto(site.url)
        page.wait_for_function("() => viewer.scene")
        page.get_by_label("Show", exact=True).select_option("Residency")
        page.evaluate("viewer.fileCameras.lookThrough(0)")
        settle(page)
        view.eye = near.position
        page.evaluate("viewer.fileCameras.lookThrough(1)")
        page.wait_for_function("() => viewer.picture.message?.figures.missing", timeout=120_000)
        page.wait_for_timeout(1000)
        save("residency", shot(page))
        view.eye, view.is_held = None, False
        browser.close()
    site.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
