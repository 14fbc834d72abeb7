"""Make viewer_*.jpg: a tab of the viewer in Chromium, in each of its modes. Needs playwright.

python docs/images/make_viewer.py donutsea.json 048_camera_8
"""

import io
import itertools
import re
import shutil
import sys
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont
from playwright.sync_api import Page, sync_playwright

import v3dg
from v3dg.viewer.frame import SceneView
from v3dg.viewer.server import Site

FOLDER = Path(__file__).parent
ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic"]
MODES = ("Colour", "Level", "Cluster", "Depth", "Alpha", "Gaussians per pixel", "Difference to all gaussians")


def main(scene_path: str, camera: str) -> None:
    scene, cameras = v3dg.read_scene(scene_path)
    site = Site(SceneView(scene, device="cpu"), name="DonutSea", cameras=cameras, port=0)
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        page = browser.new_page(viewport={"width": 1120, "height": 640})
        page.goto(f"http://127.0.0.1:{site.port}/?fixedDpr=1")
        settle(page)
        page.locator('[class*="Notification"] button').first.click()
        page.get_by_text("Camera", exact=True).click()
        page.wait_for_timeout(800)  # until the folder is open
        page.locator('input[class*="Select-input"]:visible').last.click()
        page.keyboard.type(camera)
        page.get_by_role("option", name=camera, exact=True).click()
        page.get_by_text("Camera", exact=True).click()
        save("tab", shot(page))
        modes = {MODES[0]: shot(page, canvas_only=True)}
        for before, after in itertools.pairwise(MODES):
            choose(page, before, after)
            modes[after] = shot(page, canvas_only=True)
        choose(page, MODES[-1], MODES[0])
        sliders = page.get_by_role("slider")
        sliders.nth(0).press("End")
        set_text(page, "0.5", 2)
        modes["Split: all gaussians, tolerance 32"] = shot(page, canvas_only=True)
        save("modes", sheet(modes))
        set_text(page, "0", 2)
        set_text(page, "3", 0)
        choose(page, MODES[0], MODES[1])
        page.get_by_role("checkbox").nth(1).click()
        settle(page)
        page.mouse.move(300, 250)
        page.mouse.down()
        page.mouse.move(440, 330, steps=10)
        page.mouse.up()
        for _ in range(14):
            page.mouse.wheel(0, 200)
            page.wait_for_timeout(300)
        save("frozen", shot(page))
        browser.close()
    site.close()


def settle(page: Page) -> None:
    """Wait until the picture is drawn in full."""
    page.wait_for_timeout(800)
    while True:
        found = re.search(r"picture\s+(\d+) x", page.inner_text("body"))
        width = page.locator("canvas").first.bounding_box()["width"]
        if found and abs(int(found[1]) - width) <= 1:
            page.wait_for_timeout(600)
            return
        page.wait_for_timeout(200)


def choose(page: Page, before: str, after: str) -> None:
    page.locator(f'input[value="{before}"]').first.click()
    page.get_by_role("option", name=after, exact=True).click()


def set_text(page: Page, text: str, place: int) -> None:
    """Write into the number beside a slider."""
    field = page.locator('input[class*="NumberInput-input"]:visible').nth(place)
    field.fill(text)
    field.press("Enter")


def shot(page: Page, canvas_only: bool = False) -> Image.Image:
    settle(page)
    box = page.locator("canvas").first.bounding_box()
    page.mouse.move(200, 600)  # off the controls, which would show their hints
    page.wait_for_timeout(500)
    png = page.screenshot(clip=box) if canvas_only else page.screenshot()
    return Image.open(io.BytesIO(png)).convert("RGB")


def sheet(pictures: dict[str, Image.Image]) -> Image.Image:
    """Pictures in two columns, each with its name."""
    width, height = 480, 386
    out = Image.new("RGB", (2 * width, -(-len(pictures) // 2) * height))
    font = ImageFont.load_default(size=18)
    for place, (name, picture) in enumerate(pictures.items()):
        corner = (place % 2 * width, place // 2 * height)
        out.paste(picture.resize((width, height), Image.Resampling.LANCZOS), corner)
        draw, at = ImageDraw.Draw(out), (corner[0] + 10, corner[1] + 8)
        left, top, right, bottom = draw.textbbox(at, name, font)
        draw.rectangle((left - 6, top - 4, right + 6, bottom + 4), "black")
        draw.text(at, name, "white", font)
    return out


def save(name: str, picture: Image.Image) -> None:
    picture.save(FOLDER / f"viewer_{name}.jpg", quality=82)


if __name__ == "__main__":
    main(*sys.argv[1:])
