"""Exports remove or replace only their own files in the output folder."""

import json
import os
import shutil
import stat
from pathlib import Path

import numpy as np
import pytest

import v3dg
from command_line import fails, run
from random_bundle import random_bundle
from v3dg.export import _common, _folder, write_site, write_streamed_sog, write_tiles
from v3dg.export._record import RECORD

WRITERS = {"sog": write_streamed_sog, "site": write_site, "tiles": write_tiles}
MARKS = ("lod-meta.json", "site.json", "tileset.json")


@pytest.fixture(params=WRITERS)
def write(request):
    return WRITERS[request.param]


@pytest.fixture
def bundle(tmp_path):
    """A bundle in a file, in a folder without exports."""
    path = tmp_path / "data" / "a.v3dg"
    path.parent.mkdir()
    random_bundle(1, num_levels=3).write(path)
    return v3dg.Bundle.open(path)


def contents(folder):
    """Return everything below a folder by its name: bytes of files, targets of links,
    and permissions of folders."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            found[name] = os.readlink(path)
        else:
            found[name] = stat.S_IMODE(path.stat().st_mode) if path.is_dir() else path.read_bytes()
    return found


def project(folder):
    """A folder with a user's files, some of them with names that exports use, too."""
    (folder / ".git").mkdir(parents=True)
    (folder / ".git" / "config").write_text("mine")
    (folder / "0_0").mkdir()
    (folder / "0_0" / "notes.txt").write_text("notes")
    for name in (*MARKS, "thesis.tex"):
        (folder / name).write_text(f"my {name}")
    return folder


def without(found, *names):
    return {name: value for name, value in found.items() if name not in names}


def test_a_folder_without_a_record_is_refused_and_stays(tmp_path, bundle, write):
    folder = project(tmp_path / "project")
    before = contents(folder)
    with pytest.raises(
        ValueError, match="project: expected a new folder or one with an earlier export, got"
    ):
        write(bundle, folder)
    assert contents(folder) == before


def test_overwriting_replaces_files_of_the_same_names_alone(tmp_path, bundle, write):
    folder = project(tmp_path / "project")
    before = contents(folder)
    write(bundle, folder, overwrite=True)
    write(bundle, tmp_path / "web")
    after, exported = contents(folder), contents(tmp_path / "web")
    assert without(exported, RECORD).items() <= after.items()
    assert without(before, *exported).items() <= after.items()
    assert set(after) == {*before, *exported}


def test_files_that_are_read_are_not_written_around(tmp_path, bundle, write):
    folder = tmp_path / "data"
    (tmp_path / "link").symlink_to(folder)
    before = contents(folder)
    for output in (folder, tmp_path, tmp_path / "link", Path("/")):
        for overwrite in (False, True):
            with pytest.raises(
                ValueError, match=r"contains the input .*a\.v3dg; choose another folder"
            ):
                write(bundle, output, overwrite=overwrite)
    assert contents(folder) == before


def test_the_command_refuses_a_folder_with_what_it_reads(tmp_path, bundle):
    (tmp_path / "town").mkdir()
    (tmp_path / "town" / "town.json").write_text("{}")
    scene = v3dg.Scene()
    scene.add(bundle, positions=[[0, 0, 0]])
    v3dg.write_scene(tmp_path / "town" / "town.json", scene, ["../data/a.v3dg"])
    (tmp_path / "data" / "lod-meta.json").write_text("{}")
    for cwd, name in ((tmp_path / "data", "a.v3dg"), (tmp_path / "town", "town.json")):
        before = contents(tmp_path)
        for more in ((), ("--overwrite",), ("--to", "tiles")):
            fails(
                1,
                f"contains the input {name}",
                "export",
                name,
                "-o",
                ".",
                "--quiet",
                *more,
                cwd=cwd,
            )
        assert contents(tmp_path) == before
    with pytest.raises(ValueError, match=r"contains the input .*town\.json"):
        write_site(tmp_path / "town" / "town.json", tmp_path / "town", overwrite=True)


def test_the_command_overwrites_when_it_is_told_to(tmp_path, bundle):
    project(tmp_path / "project")
    arguments = ("export", "data/a.v3dg", "-o", "project", "--quiet")
    fails(1, "choose another folder, or overwrite", *arguments, cwd=tmp_path)
    done = run(*arguments, "--overwrite", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "project" / "thesis.tex").read_text() == "my thesis.tex"


def test_another_export_replaces_all_of_the_earlier_one_and_nothing_else(tmp_path, bundle, write):
    for earlier in WRITERS.values():
        folder = tmp_path / "web"
        earlier(bundle, folder)
        names = set(contents(folder))
        (folder / "mine").mkdir()
        (folder / "mine" / "0_0").write_text("mine")
        below = next(path for path in folder.iterdir() if path.is_dir() and path.name in names)
        (below / "notes.txt").write_text("notes")
        write(bundle, folder)
        write(bundle, tmp_path / "other")
        left = {"mine", "mine/0_0", below.name, f"{below.name}/notes.txt"}
        assert set(contents(folder)) == {*contents(tmp_path / "other"), *left}
        assert (below / "notes.txt").read_text() == "notes"
        shutil.rmtree(folder)
        shutil.rmtree(tmp_path / "other")


def test_the_folder_itself_stays_with_its_permissions(tmp_path, bundle, write):
    folder = tmp_path / "web"
    folder.mkdir()
    folder.chmod(0o2750)
    before = folder.stat()
    for _ in range(2):
        write(bundle, folder)
        after = folder.stat()
        assert (after.st_mode, after.st_ino) == (before.st_mode, before.st_ino)


def test_a_link_to_a_folder_stays_a_link(tmp_path, bundle, write):
    (tmp_path / "disk").mkdir()
    (tmp_path / "web").symlink_to(tmp_path / "disk")
    (tmp_path / "later").symlink_to(tmp_path / "absent" / "web")
    for name in ("web", "later"):
        write(bundle, tmp_path / name)
        write(bundle, tmp_path / name)
        assert (tmp_path / name).is_symlink()
        assert (tmp_path / name / RECORD).exists()
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(ValueError, match="loop: expected a new folder"):
        write(bundle, tmp_path / "loop")


def test_a_file_that_was_changed_since_is_not_lost(tmp_path, bundle):
    folder = tmp_path / "web"
    write_site(bundle, folder)
    (folder / "index.html").write_text("my page")
    before = contents(folder)
    with pytest.raises(
        ValueError, match=r"index\.html: expected a file of an earlier export, got one that was"
    ):
        write_site(bundle, folder)
    assert contents(folder) == before
    write_streamed_sog(bundle, folder)  # this function writes no web page
    assert (folder / "index.html").read_text() == "my page"
    write_site(bundle, folder, overwrite=True)
    assert "my page" not in (folder / "index.html").read_text()


def test_a_file_that_is_in_the_way_of_a_new_one_stays(tmp_path, bundle):
    """This also holds for a name that is known only after everything else was
    written."""
    folder = tmp_path / "web"
    write_tiles(bundle, folder)
    (folder / "0_0").mkdir()
    (folder / "0_0" / "meta.json").write_text("mine")
    before = contents(folder)
    with pytest.raises(
        ValueError, match=r"web/0_0/meta\.json: expected a file of an earlier export, got"
    ):
        write_streamed_sog(bundle, folder)
    assert contents(folder) == before


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("name", ["index.html", "0_0", "0_0/meta.json", "settings.json", RECORD])
@pytest.mark.parametrize(
    "kind", ["link to a file", "link to a folder", "link to nothing", "folder", "pipe"]
)
def test_nothing_is_written_through_links(tmp_path, bundle, name, kind, overwrite):
    folder, outside = tmp_path / "web", tmp_path / "outside"
    (folder / name).parent.mkdir(parents=True)
    outside.mkdir()
    (outside / "meta.json").write_text("elsewhere")
    targets = {"file": outside / "meta.json", "folder": outside, "nothing": outside / "absent"}
    if kind.startswith("link"):
        (folder / name).symlink_to(targets[kind.split()[-1]])
    elif kind == "pipe":
        os.mkfifo(folder / name)
    else:
        (folder / name).mkdir()
    if kind == "folder" and name == "0_0":
        pytest.skip("a folder of that name is no obstacle")
    names = sorted(os.listdir(folder))
    with pytest.raises(ValueError, match="expected"):
        write_site(bundle, folder, overwrite=overwrite)
    assert sorted(os.listdir(folder)) == names
    assert contents(outside) == {"meta.json": b"elsewhere"}


def test_the_other_name_of_a_file_keeps_its_content(tmp_path, bundle):
    folder = tmp_path / "web"
    write_site(bundle, folder)
    for name in ("site.json", "index.html"):
        os.link(folder / name, tmp_path / name)
    before = contents(tmp_path / "web")
    write_tiles(bundle, folder)
    assert (tmp_path / "site.json").read_bytes() == before["site.json"]
    assert (tmp_path / "index.html").read_bytes() == before["index.html"]


@pytest.mark.parametrize(
    "name",
    [
        "../victim.json",
        "a/../../victim.json",
        "/etc/victim.json",
        "a//victim.json",
        "./victim.json",
        ".git/config.json",
        "victim.txt",
        "victim.json\n",
        "a/b/c/victim.json",
        "link/../victim.json",
        "é.json",
        "",
        RECORD,
    ],
)
@pytest.mark.parametrize("field", ["files", "folders"])
def test_a_record_that_names_what_no_export_writes_is_refused(tmp_path, bundle, name, field):
    folder = tmp_path / "web"
    write_tiles(bundle, folder)
    (tmp_path / "victim.json").write_text("victim")
    record = json.loads((folder / RECORD).read_text())
    if field == "files":
        record["files"][name] = [
            6,
            v3dg.export._record._content_of_path(tmp_path / "victim.json").digest,
        ]
    else:
        record["folders"].append(name)
    (folder / RECORD).write_text(json.dumps(record))
    before = contents(tmp_path)
    for overwrite in (False, True):
        with pytest.raises(
            ValueError,
            match=rf"{RECORD}: {field}.*: expected the name of a file that an export writes",
        ):
            write_tiles(bundle, folder, overwrite=overwrite)
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{", "\0", '{"format": "v3dg-export"}', "[" * 100_000],
    ids=["nothing", "array", "cut off", "zero", "fields missing", "deep"],
)
def test_a_damaged_record_is_refused(tmp_path, bundle, text):
    folder = tmp_path / "web"
    write_tiles(bundle, folder)
    (folder / RECORD).write_text(text)
    before = contents(folder)
    with pytest.raises(ValueError, match=rf"{RECORD}: .*expected"):
        write_tiles(bundle, folder)
    assert contents(folder) == before


@pytest.mark.parametrize(
    "content", [[-1, "0" * 32], [True, "0" * 32], [1], [1, "xyz"], [1, 2], 5, {}]
)
def test_a_record_with_other_values_is_refused(tmp_path, bundle, content):
    folder = tmp_path / "web"
    write_tiles(bundle, folder)
    record = json.loads((folder / RECORD).read_text())
    record["files"]["index.html"] = content
    (folder / RECORD).write_text(json.dumps(record))
    before = contents(folder)
    with pytest.raises(ValueError, match=rf"{RECORD}: files\.index\.html.*expected"):
        write_tiles(bundle, folder)
    assert contents(folder) == before


def test_a_record_removes_no_file_with_another_content(tmp_path, bundle):
    folder = tmp_path / "web"
    write_tiles(bundle, folder)
    (folder / "data").mkdir()
    (folder / "data" / "cities.json").write_text("mine")
    record = json.loads((folder / RECORD).read_text())
    record["files"]["data/cities.json"] = [4, "0" * 32]
    record["folders"].append("data")
    (folder / RECORD).write_text(json.dumps(record))
    write_tiles(bundle, folder)
    assert (folder / "data" / "cities.json").read_text() == "mine"


class Moves:
    """Makes one of the calls that rename files fail."""

    def __init__(self, monkeypatch, moment, error):
        rename, self.count = os.rename, 0

        def counted(*arguments, **options):
            if self.count == moment and error is OSError:
                self.count += 1
                raise OSError(5, "Input/output error")
            rename(*arguments, **options)
            self.count += 1
            if self.count == moment + 1 and error is not OSError:
                raise error

        monkeypatch.setattr(os, "rename", counted)


def write_files(bundle, folder, files):
    with _folder.replacing_export(folder, v3dg.Scene.of(bundle)) as new:
        for name in files:
            (new.path / name).parent.mkdir(exist_ok=True)
            (new.path / name).write_text(f"{name} of {len(files)}")


def write_first(bundle, folder):
    write_files(
        bundle, folder, ("index.html", "0_0/meta.json", "0_0/means_l.webp", "1_0/meta.json")
    )


def write_second(bundle, folder):
    write_files(bundle, folder, ("index.html", "a/tileset.json", "1_0/meta.json"))


def two_exports(tmp_path, bundle):
    """Return the content of a folder after exports of two kinds, with a user's file."""
    states = []
    for number, write in enumerate((write_first, write_second)):
        folder = tmp_path / str(number)
        write(bundle, folder)
        (folder / "mine.txt").write_text("mine")
        states.append(contents(folder))
    return states


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
def test_an_export_that_fails_as_it_takes_its_place_is_whole_or_gone(
    tmp_path, bundle, monkeypatch, error
):
    earlier, later = two_exports(tmp_path, bundle)
    moment, has_ended = 0, False
    while not has_ended:
        folder = tmp_path / f"web_{moment}"
        write_first(bundle, folder)
        (folder / "mine.txt").write_text("mine")
        with monkeypatch.context() as patch:
            moves = Moves(patch, moment, error)
            try:
                write_second(bundle, folder)
                has_ended = True
                assert moves.count == moment
            except error:
                assert contents(folder) in (earlier, later)
        moment += 1
    assert contents(folder) == later
    assert moment == 10


def test_an_export_goes_back_where_one_before_was_killed(tmp_path, bundle, monkeypatch):
    """The export is killed at every rename, and the next export fails. The folder then
    has the whole content of one of the two exports."""
    earlier, later = two_exports(tmp_path, bundle)
    moment, was_killed = 0, True
    while was_killed:
        folder = tmp_path / f"web_{moment}"
        write_first(bundle, folder)
        (folder / "mine.txt").write_text("mine")
        with monkeypatch.context() as patch:
            patch.setattr(_folder, "_restore_and_remove", lambda *_: None)
            moves = Moves(patch, moment, SystemExit)
            try:
                write_second(bundle, folder)
                was_killed = False
            except SystemExit:
                pass
            assert moves.count == moment + was_killed
        with (
            pytest.raises(ValueError, match="chunk: expected"),
            _folder.replacing_export(folder, v3dg.Scene.of(bundle)),
        ):
            raise ValueError("chunk: expected")
        found = contents(folder)
        if was_killed:
            assert found in (earlier, later), moment
        moment += 1
    assert moment == 10


def test_what_a_killed_export_wrote_before_it_was_complete_is_no_obstacle(
    tmp_path, bundle, monkeypatch, write
):
    def killed(*_):
        raise SystemExit

    folder = tmp_path / "web"
    with monkeypatch.context() as patch:
        patch.setattr(_folder, "_restore_and_remove", lambda *_: None)
        patch.setattr(_folder.Record, "of_files_below", killed)
        with pytest.raises(SystemExit):
            write(bundle, folder)
    (left,) = os.listdir(folder)
    write(bundle, folder)
    write(bundle, tmp_path / "other")
    assert set(os.listdir(folder)) == {left, *os.listdir(tmp_path / "other")}


def test_two_exports_at_once_do_not_mix(tmp_path, bundle, write):
    folder = tmp_path / "web"
    with _folder.replacing_export(folder, v3dg.Scene.of(bundle)) as new:
        with pytest.raises(RuntimeError, match="web: another export is using it; wait for it"):
            write(bundle, folder)
        (new.path / "index.html").write_text("first")
    assert set(os.listdir(folder)) == {"index.html", RECORD}
    write(bundle, folder)


def test_a_file_that_appears_meanwhile_stays(tmp_path, bundle):
    folder = tmp_path / "web"

    def write():
        with _folder.replacing_export(folder, v3dg.Scene.of(bundle)) as new:
            (new.path / "index.html").write_text("new")
            (folder / "index.html").write_text("mine")

    with pytest.raises(ValueError, match=r"index\.html: expected a file of an earlier export"):
        write()
    assert contents(folder) == {"index.html": b"mine"}


def test_bundles_whose_names_clash_have_folders_of_their_own(tmp_path):
    scene, counts = v3dg.Scene(), []
    for number, name in enumerate(
        ("a_2", "a", "A", "x/a", "x/a b", "a_b", "x/A_2", "cesium", "CESIUM")
    ):
        path = tmp_path / "data" / f"{name}.v3dg"
        path.parent.mkdir(parents=True, exist_ok=True)
        bundle = random_bundle(number, num_levels=2, max_cluster=20)
        bundle.write(path)
        scene.add(v3dg.Bundle.open(path), positions=[[0, 0, 0]])
        counts.append(len(bundle.level_gaussians(0)))
    write_site(scene, tmp_path / "site")
    site = json.loads((tmp_path / "site" / "site.json").read_text())
    urls = [listed["url"] for listed in site["bundles"]]
    assert len({url.casefold() for url in urls}) == len(counts)
    assert [len(v3dg.read_asset(tmp_path / "site" / url)) for url in urls] == counts
    write_tiles(scene, tmp_path / "tiles")
    folders = [path.name for path in (tmp_path / "tiles").iterdir() if path.is_dir()]
    assert len({name.casefold() for name in (*folders, "cesium")}) == len(counts) + 1


def test_names_become_distinct():
    assert _common.distinct(["_a", "_a", "_A_1", "_a"], reserved=["B"]) == [
        "_a",
        "_a_1",
        "_A_1_2",
        "_a_3",
    ]
    assert _common.distinct(["b"], reserved=["B"]) == ["b_0"]


def test_usd_has_each_bundle_once_where_names_clash(tmp_path):
    pytest.importorskip("pxr")
    scene = v3dg.Scene()
    for number in (1, 2):  # names of USD prims cannot begin with a digit
        random_bundle(number).write(tmp_path / f"{number}a.v3dg")
        scene.add(v3dg.Bundle.open(tmp_path / f"{number}a.v3dg"), positions=[[0, 0, 0]])
    v3dg.write_usd(scene, tmp_path / "a.usda")
    counts = [len(bundle.level_gaussians(0)) for bundle in scene.bundles]
    again = v3dg.open(tmp_path / "a.usda")
    assert sorted(len(bundle.level_gaussians(0)) for bundle in again.bundles) == sorted(counts)


def test_an_engine_that_somebody_put_there_stays(tmp_path, bundle, monkeypatch):
    build = tmp_path / "node_modules/playcanvas/build"
    build.mkdir(parents=True)
    (build / "playcanvas.min.mjs").write_text("of npm")
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "site"
    write_site(bundle, folder)
    (folder / "playcanvas.min.mjs").write_text("mine, and newer")
    assert write_site(bundle, folder).has_engine
    assert (folder / "playcanvas.min.mjs").read_text() == "mine, and newer"
    write_tiles(bundle, folder)
    assert (folder / "playcanvas.min.mjs").read_text() == "mine, and newer"


def test_errors_name_files_as_they_will_be_called(tmp_path, bundle, monkeypatch):
    def full(path, _):
        raise OSError(28, "No space left on device", os.fspath(path))

    monkeypatch.setattr(_common, "write_document", full)
    with pytest.raises(OSError, match="No space left on device") as error:
        write_streamed_sog(bundle, tmp_path / "new" / "web")
    assert error.value.filename == str(tmp_path / "new" / "web" / "lod-meta.json")
    assert not (tmp_path / "new").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_may_not_be_written_to_is_named(tmp_path, bundle, write):
    (tmp_path / "web").mkdir(mode=0o555)
    with pytest.raises(PermissionError, match="web"):
        write(bundle, tmp_path / "web")
    assert os.listdir(tmp_path / "web") == []


def test_an_export_is_recorded_whole(tmp_path, bundle):
    """The record lists every file that was written, with its size, and every folder."""
    write_site(bundle, tmp_path / "web")
    record = json.loads((tmp_path / "web" / RECORD).read_text())
    found = without(contents(tmp_path / "web"), RECORD)
    files = {name: len(content) for name, content in found.items() if isinstance(content, bytes)}
    assert {name: size for name, (size, _) in record["files"].items()} == files
    assert set(record["folders"]) == set(found) - set(files)
    assert np.sum(list(files.values())) == write_site(bundle, tmp_path / "other").bytes
