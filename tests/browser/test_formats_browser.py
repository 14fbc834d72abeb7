"""The files that we write look in the engines of other projects as we draw them, in
Chromium. The tests need playwright, Chromium on PATH, and the environment variable
NODE_MODULES. This is the folder that `npm install playcanvas@2.23.3 three@0.187.0
@sparkjsdev/spark@2.2.0 babylonjs@9.28.0 babylonjs-loaders@9.28.0 @adobe/spz@0.2.2
fflate@0.8.3` creates. If SCREENSHOTS names a folder, the pictures of the engines and
ours are saved there.
"""

import dataclasses
import functools
import http.server
import io
import os
import threading
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import chromium
import v3dg
from benchmarks.worlds.procedural import make_donut
from v3dg.export import write_streamed_sog
from v3dg.formats import _axes
from v3dg.metrics import psnr

pytest.importorskip("playwright.sync_api")

MODULES, SCREENSHOTS = os.environ.get("NODE_MODULES"), os.environ.get("SCREENSHOTS")
pytestmark = [
    pytest.mark.witness,
    pytest.mark.skipif(
        chromium.PROGRAM is None, reason="neither chromium nor google-chrome is installed"
    ),
    pytest.mark.skipif(MODULES is None, reason="NODE_MODULES does not name its folder"),
]

SIDE, FOV = 300, 40
EYE = (0.18, -0.38, 0.30)  # z of the donut points up
UP = (0.0, 0.0, 1.0)
# The axes of the formats in which assets are rotated. In the donut, z is up.
AXES = {".spz": _axes.OPENGL, ".glb": _axes.GLTF}

# Each page looks from EYE at the origin with UP up, and counts its pictures since the
# asset was loaded.
HEAD = """<!doctype html>
<style>
body { margin: 0; overflow: hidden }
canvas { width: 100vw; height: 100vh; display: block }
</style>
<canvas id="canvas"></canvas>
<script>const file = "FILE", eye = EYE, up = UP, canvas = document.getElementById("canvas");
window.frames_shown = 0;</script>
"""
PAGES = {
    "playcanvas": """<script type="module">
import * as pc from "./modules/playcanvas/build/playcanvas.min.mjs";
const options = new pc.AppOptions();
options.graphicsDevice = await pc.createGraphicsDevice(canvas, { deviceTypes: ["webgl2"] });
options.componentSystems = [
  pc.CameraComponentSystem, pc.GSplatComponentSystem, pc.RenderComponentSystem];
options.resourceHandlers = [pc.TextureHandler, pc.GSplatHandler, pc.ContainerHandler];
const app = new pc.AppBase(canvas);
app.init(options);
app.setCanvasFillMode(pc.FILLMODE_FILL_WINDOW);
app.setCanvasResolution(pc.RESOLUTION_AUTO);
app.start();
const camera = new pc.Entity();
camera.addComponent("camera", { clearColor: new pc.Color(0, 0, 0), fov: FOV, nearClip: 0.01 });
app.root.addChild(camera);
camera.setPosition(...eye);
camera.lookAt(new pc.Vec3(0, 0, 0), new pc.Vec3(...up));
const glb = file.endsWith(".glb");
const asset = new pc.Asset(file, glb ? "container" : "gsplat", { url: file });
app.assets.add(asset);
asset.on("error", (error) => { throw new Error(error); });
asset.ready(() => {
  const entity = glb ? asset.resource.instantiateRenderEntity() : new pc.Entity();
  if (!glb) entity.addComponent("gsplat", { asset });
  app.root.addChild(entity);
  app.on("frameend", () => app.stats.frame.gsplats && window.frames_shown++);
});
app.assets.load(asset);
</script>""",
    "spark": """<script type="importmap">{ "imports": {
  "three": "./modules/three/build/three.module.js",
  "three/addons/": "./modules/three/examples/jsm/",
  "@sparkjsdev/spark": "./modules/@sparkjsdev/spark/dist/spark.module.js" } }</script>
<script type="module">
import * as THREE from "three";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
const renderer = new THREE.WebGLRenderer({ canvas });
renderer.setSize(innerWidth, innerHeight);
const scene = new THREE.Scene();
const camera = new THREE.PerspectiveCamera(FOV, innerWidth / innerHeight, 0.01, 100);
scene.add(new SparkRenderer({ renderer }));
camera.up.set(...up);
camera.position.set(...eye);
camera.lookAt(0, 0, 0);
const mesh = new SplatMesh({ url: file });
scene.add(mesh);
await mesh.initialized;
renderer.setAnimationLoop(() => { renderer.render(scene, camera); window.frames_shown++; });
</script>""",
    # Babylon's coordinates are left-handed. It reflects y of the assets that it loads,
    # so y of the eye is reflected, too.
    "babylon": """<script src="modules/babylonjs/babylon.js"></script>
<script src="modules/babylonjs-loaders/babylonjs.loaders.min.js"></script>
<script type="module">
const engine = new BABYLON.Engine(canvas, false), scene = new BABYLON.Scene(engine);
scene.clearColor = new BABYLON.Color4(0, 0, 0, 1);
const glb = file.endsWith(".glb");
scene.useRightHandedSystem = glb;
const reflected = ([x, y, z]) => new BABYLON.Vector3(x, glb ? y : -y, z);
const camera = new BABYLON.FreeCamera("camera", reflected(eye), scene);
camera.upVector = reflected(up);
camera.setTarget(BABYLON.Vector3.Zero());
camera.fov = FOV * Math.PI / 180;
camera.minZ = 0.01;
const local = (path) => new URL("modules/" + path, location).href;
const splat = {
  deflateURL: local("fflate/umd/index.js"), spzLibraryUrl: local("@adobe/spz/dist/spz.js") };
if (file.endsWith(".json")) {
  const folder = new URL(file, location), index = await (await fetch(folder)).json();
  const root = new URL(".", folder).href;
  const streamed = new BABYLON.GaussianSplattingStream("streamed", index, root, scene, splat);
  streamed.rotation.x = 0;  // It turns an asset, so that y is up.
} else {
  await BABYLON.ImportMeshAsync(file, scene, { pluginOptions: { splat } });
}
await scene.whenReadyAsync();
engine.runRenderLoop(() => { scene.render(); window.frames_shown++; });
</script>""",
}


class Handler(http.server.SimpleHTTPRequestHandler):
    """A web server of files that logs nothing."""

    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def asset():
    return make_donut(20_000, sh_degree=2)


@pytest.fixture(scope="module")
def site(tmp_path_factory, asset):
    """Return the address of a folder with files of an asset, and the folder."""
    folder = tmp_path_factory.mktemp("files")
    for suffix in ("ply", "compressed.ply", "spz", "sog", "glb"):
        v3dg.write_asset(folder / f"donut.{suffix}", asset, up="z")
    bundle = v3dg.build_bundle(asset, config=v3dg.BuildConfig(steps=0), progress=False)
    write_streamed_sog(bundle, folder / "streamed", chunk=6000, up="-y")
    (folder / "modules").symlink_to(MODULES)
    handler = functools.partial(Handler, directory=folder)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever).start()
        yield f"http://127.0.0.1:{server.server_address[1]}", folder
        server.shutdown()


def shown(browser, site, engine, file):
    """Return the picture (H, W, 3) of an engine's page once it no longer changes."""
    address, folder = site
    page_file = folder / f"{engine}.html"
    turn = np.eye(3)
    if page_file.with_name(file).suffix in AXES:
        turn = _axes.turn(_axes.axes_of_up("z"), AXES[page_file.with_name(file).suffix])
    html = HEAD.replace("FILE", file) + PAGES[engine]
    html = html.replace("EYE", str((turn @ EYE).tolist())).replace("UP", str((turn @ UP).tolist()))
    page_file.write_text(html.replace("FOV", str(FOV)))
    page, errors = browser.new_page(viewport={"width": SIDE, "height": SIDE}), []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(f"{address}/{page_file.name}")
    picture = before = None
    for _ in range(60):
        page.wait_for_timeout(1000)
        before, picture = (
            picture,
            np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")) / 255,
        )
        if errors or (
            page.evaluate("frames_shown") > 3
            and picture.max() > 0.2
            and np.array_equal(before, picture)
        ):
            break
    page.close()
    assert errors == []
    return picture


@pytest.mark.parametrize(
    ("engine", "file"),
    [
        *(("playcanvas", f"donut.{suffix}") for suffix in ("ply", "compressed.ply", "sog", "glb")),
        *(("spark", f"donut.{suffix}") for suffix in ("ply", "compressed.ply", "spz", "sog")),
        *(
            ("babylon", f"donut.{suffix}")
            for suffix in ("ply", "compressed.ply", "spz", "sog", "glb")
        ),
        ("babylon", "streamed/lod-meta.json"),
    ],
)
def test_an_engine_draws_what_we_do(browser, site, asset, engine, file):
    picture = shown(browser, site, engine, file)
    camera = v3dg.Camera.look_at(
        EYE, (0, 0, 0), (0, 0, 1), fov_x=np.radians(FOV), width=SIDE, height=SIDE
    )
    if file.endswith(".json"):  # Babylon does not load the harmonics of streamed assets
        asset = dataclasses.replace(asset, sh=np.ascontiguousarray(asset.sh[:, :1]))
    ours = np.clip(v3dg.rasterize(asset, camera, filter_px2=0.3).color, 0, 1)
    if SCREENSHOTS:
        both = np.concatenate([picture, ours], axis=1)
        name = f"{engine}_{file.replace('/', '_')}.png"
        Image.fromarray((255 * both).round().astype(np.uint8)).save(Path(SCREENSHOTS) / name)
    print(f"{engine}, {file}: {psnr(picture, ours):.1f} dB")
    assert psnr(picture, ours) > 32
