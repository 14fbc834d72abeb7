"""Makes viewer_*.jpg: the viewer in Chromium, in each mode, and at the size of a phone.
The script needs playwright.

python docs/images/make_viewer.py donutsea.json 048_camera_8
"""

import io
import shutil
import sys
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont
from playwright.sync_api import Page, sync_playwright

import v3dg
from v3dg.viewer.frame import SceneView
from v3dg.viewer.server import Site

FOLDER = Path(__file__).parent
ARGUMENTS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
]
MODES = (
    *("Colour", "Level", "Cluster", "Error", "Depth", "Alpha"),
    *("Gaussians per pixel", "Difference to all gaussians"),
)


def main(scene_path: str, camera: str) -> None:
    scene, cameras = v3dg.read_scene(scene_path)
    site = Site(SceneView(scene, device="cpu"), name="DonutSea", cameras=cameras, port=0)
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        page = browser.new_page(viewport={"width": 1120, "height": 640})
        page.goto(site.url)
        look_through(page, camera)
        save("tab", shot(page))
        page.mouse.click(330, 400)
        page.wait_for_function("() => viewer.instances.selected")
        settle(page)
        save("instance", shot(page))
        page.keyboard.press("Escape")
        pictures = []
        for mode in MODES:
            page.get_by_label("Show", exact=True).select_option(mode)
            settle(page)
            pictures.append(shown(page))
        page.get_by_label("Show", exact=True).select_option(MODES[0])
        for slider, value in (("Split", 0.5), ("Tolerance px²", 32)):
            page.get_by_role("slider", name=slider).evaluate(
                "(e, v) => { e.value = v; e.dispatchEvent(new Event('input')); }", value
            )
        settle(page)
        pictures.append(shown(page))
        save("modes", sheet(pictures, [*MODES, "Split, tolerance 32"], columns=3))
        page.get_by_role("slider", name="Split").evaluate(
            "e => { e.value = 0; e.dispatchEvent(new Event('input')); }"
        )
        page.evaluate("viewer.change({ tolerance: 3 })")
        page.get_by_label("Show", exact=True).select_option("Level")
        page.get_by_label("Freeze the cut").check()
        page.keyboard.press("h")
        page.wait_for_timeout(1000)
        page.mouse.move(400, 300)
        page.mouse.down()
        page.mouse.move(470, 320, steps=5)
        page.mouse.up()
        settle(page)
        save("frozen", shot(page))
        phone = browser.new_context(
            viewport={"width": 390, "height": 700},
            device_scale_factor=1,
            is_mobile=True,
            has_touch=True,
        ).new_page()
        phone.goto(site.url)
        look_through(phone, camera)
        folded = shot(phone)
        phone.get_by_role("button", name="Panel").tap()
        settle(phone)
        save("phone", sheet([folded, shot(phone)], ["", ""], columns=2))
        browser.close()
    site.close()


def look_through(page: Page, camera: str) -> None:
    settle(page)
    place = f"viewer.fileCameras.indexOf({camera!r})"
    page.evaluate(f"viewer.fileCameras.lookThrough({place})")
    settle(page)


def settle(page: Page) -> None:
    """Wait until the picture is complete."""
    page.wait_for_timeout(1000)
    page.wait_for_selector("body[data-state=ready]", timeout=300_000)
    page.wait_for_timeout(300)


def shot(page: Page) -> Image.Image:
    return Image.open(io.BytesIO(page.screenshot()))


def shown(page: Page) -> Image.Image:
    box = page.locator("#stage").bounding_box()
    return Image.open(io.BytesIO(page.screenshot(clip=box))).resize(
        (360, round(360 * box["height"] / box["width"]))
    )


def sheet(pictures: list[Image.Image], names: list[str], columns: int) -> Image.Image:
    """Return the pictures in rows, labelled with their names."""
    width, height = pictures[0].size
    rows = -(-len(pictures) // columns)
    whole = Image.new("RGB", (columns * width + 6 * (columns - 1), rows * height + 6 * (rows - 1)))
    draw, font = ImageDraw.Draw(whole), ImageFont.load_default(16)
    for place, (picture, name) in enumerate(zip(pictures, names, strict=True)):
        corner = place % columns * (width + 6), place // columns * (height + 6)
        whole.paste(picture.convert("RGB"), corner)
        draw.text(
            (corner[0] + 10, corner[1] + 8),
            name,
            "white",
            font,
            stroke_width=2,
            stroke_fill="black",
        )
    return whole


def save(name: str, picture: Image.Image) -> None:
    """Save a picture in a file of at most 150 kB."""
    path = FOLDER / f"viewer_{name}.jpg"
    for quality in (86, 78, 70, 60, 50):
        picture.convert("RGB").save(path, quality=quality, optimize=True)
        if path.stat().st_size <= 150_000:
            return


if __name__ == "__main__":
    main(*sys.argv[1:])
