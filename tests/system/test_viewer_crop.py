"""The web page of the viewer crops the shown asset by a box: which file this writes,
and where cropping is refused."""

import time
from urllib.parse import urlsplit

import numpy as np
import pytest

import v3dg
from v3dg.viewer.frame import SceneView
from v3dg.viewer.server import Site

viewer_client = pytest.importorskip("viewer_client")

pytestmark = [
    pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning"),
    pytest.mark.usefixtures("collected_connections"),
]

BOX = ((-1.0, -1.0, -1.0), (0.1, 1.0, 1.0))


@pytest.fixture
def folder(blob_bundle, tmp_path):
    blob_bundle.write(tmp_path / "blob.v3dg")
    return tmp_path


@pytest.fixture
def site(folder):
    bundle = v3dg.Bundle.open(folder / "blob.v3dg")
    site = Site(SceneView(bundle, device="cpu"), name="blob", port=0, edits_folder=folder)
    site.whole = bundle.level_gaussians(0)
    yield site
    assert site.close()


def crop(tab, name, keep="inside", box=BOX, instance=0):
    """Request a crop; return the notice or the file that answers, or None after half a
    second."""
    tab.notices.clear()
    tab.answers.pop("done", None)
    tab.send({"type": "crop", "instance": instance, "box": box, "keep": keep, "name": name})
    end = time.monotonic() + 30
    while "done" not in tab.answers and not tab.notices and time.monotonic() < end:
        tab.pictures(time.perf_counter() + 0.05)
    tab.pictures(time.perf_counter() + 0.1)
    return tab.notices[-1] if tab.notices else None


@pytest.mark.parametrize("keep", ["inside", "outside"])
@pytest.mark.parametrize("suffix", [".ply", ".spz"])
def test_a_new_asset_is_written_beside_what_is_shown(site, folder, keep, suffix):
    with viewer_client.Tab(site.port) as tab:
        assert tab.scene["writes_files"] is True
        notice = crop(tab, f"part{suffix}", keep)
    expected = v3dg.crop_box(site.whole, *BOX, keep=keep)
    assert 0 < len(expected) < len(site.whole)
    written = v3dg.read_asset(folder / f"part{suffix}")
    np.testing.assert_allclose(written.means, expected.means, atol=1e-3)
    counts = f"{len(expected):,} of {len(site.whole):,} gaussians"
    assert (
        notice == f"part{suffix} was written beside the file that is shown; it contains {counts}."
    )
    assert sorted(path.name for path in folder.iterdir()) == ["blob.v3dg", f"part{suffix}"]


def test_no_file_is_ever_overwritten(site, folder):
    (folder / "there.ply").write_text("mine")
    (folder / "link.ply").symlink_to(folder / "elsewhere.ply")
    before = (folder / "blob.v3dg").read_bytes()
    with viewer_client.Tab(site.port) as tab:
        for name in ("there.ply", "link.ply"):
            notice = crop(tab, name)
            assert notice == (
                f"Not done: {name}: a file with this name already exists; choose another name"
            )
    assert (folder / "there.ply").read_text() == "mine"
    assert not (folder / "elsewhere.ply").exists()
    assert (folder / "blob.v3dg").read_bytes() == before


@pytest.mark.parametrize(
    "name",
    ["../up.ply", "a/b.ply", "..", ".hidden.ply", ".ply", "blob.v3dg", "a.txt", "a.ply\n",
     "a\\b.ply", "/tmp/a.ply", "", "x" * 300 + ".ply"],
)  # fmt: skip
def test_other_names_write_nothing(site, folder, name):
    with viewer_client.Tab(site.port) as tab:
        tab.send({"type": "crop", "instance": 0, "box": BOX, "keep": "inside", "name": name})
        assert "was written" in crop(tab, "after.ply")  # the connection still works
    names = ["after.ply", "blob.v3dg"]
    assert sorted(path.name for path in folder.iterdir()) == names
    assert not (folder.parent / "up.ply").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"box": ((8, 8, 8), (9, 9, 9))}, "Not done: box: nothing remains of"),
        ({"box": ((1, 0, 0), (0, 1, 1))}, "Not done: low, high: expected high to be at least low"),
        ({"instance": 1}, "Not done: instance: expected 0 to 0, got 1"),
    ],
)
def test_wrong_boxes_are_explained_and_write_nothing(site, folder, options, message):
    with viewer_client.Tab(site.port) as tab:
        assert crop(tab, "a.ply", **options).startswith(message)
    assert [path.name for path in folder.iterdir()] == ["blob.v3dg"]


def test_without_a_folder_the_browser_saves(folder):
    scene = v3dg.Scene()
    scene.add(v3dg.Bundle.open(folder / "blob.v3dg"), [(0, 0, 0), (9, 0, 0)])
    site = Site(SceneView(scene, device="cpu"), name="pair", port=0)
    with viewer_client.Tab(site.port) as tab:
        assert tab.scene["writes_files"] is False
        crop(tab, "part.ply", instance=1)
        (folder / "saved.ply").write_bytes(tab.files["part.ply"])
    assert site.close()
    whole = scene.bundles[0].level_gaussians(0)
    written = v3dg.read_asset(folder / "saved.ply")
    np.testing.assert_array_equal(written.means, v3dg.crop_box(whole, *BOX).means)


def test_who_can_connect_from_elsewhere_writes_nothing(folder):
    bundle = v3dg.Bundle.open(folder / "blob.v3dg")
    site = Site(SceneView(bundle, device="cpu"), host="0.0.0.0", port=0, edits_folder=folder)
    with viewer_client.Tab(site.port, urlsplit(site.url).path) as tab:
        assert tab.scene["writes_files"] is False
        crop(tab, "part.ply")
        assert list(tab.files) == ["part.ply"]
    assert site.close()
    assert [path.name for path in folder.iterdir()] == ["blob.v3dg"]


def test_a_dropped_file_is_cropped_by_the_browser(site, folder):
    v3dg.write_asset(folder / "other.ply", site.whole.subset(slice(0, 50)))
    with viewer_client.Tab(site.port) as tab:
        tab.drop("other.ply", (folder / "other.ply").read_bytes())
        end = time.monotonic() + 30
        while tab.scene["writes_files"] and time.monotonic() < end:
            tab.pictures(time.perf_counter() + 0.05)
        crop(tab, "part.ply")
        assert list(tab.files) == ["part.ply"]
    assert not (folder / "part.ply").exists()


def test_view_writes_beside_the_file_that_it_shows(folder):
    site = v3dg.view(folder / "blob.v3dg", device="cpu", port=0)
    with viewer_client.Tab(site.port) as tab:
        assert "was written" in crop(tab, "part.ply")
    assert site.close()
    assert (folder / "part.ply").exists()
