import json
import os
import signal
import subprocess
import time

import numpy as np
import pytest

import v3dg
from benchmarks.worlds.procedural import make_asset
from command_line import COMMAND, ENVIRONMENT, fails, run
from v3dg.io import run_files
from v3dg.levels import build_file

FAST = ("--quiet", "--cluster-size", 64)


def tiny(seed=0):
    return make_asset(1000, seed=seed).subset(slice(300))


@pytest.fixture
def folder(tmp_path):
    """Three assets, one of which cannot be read, and a file that is not an asset."""
    for name in ("a", "c"):
        v3dg.write_asset(tmp_path / f"{name}.ply", tiny(ord(name)))
    (tmp_path / "b.ply").write_bytes(b"ply\n")
    (tmp_path / "notes.txt").write_text("not an asset")
    return tmp_path


def test_one_that_fails_does_not_stop_the_others(folder):
    done = run("build", ".", *FAST, "--json", cwd=folder)
    assert done.returncode == 1
    assert done.stderr.startswith("v3dg: error: 1 of 3 assets failed: b.ply: ")
    assert done.stderr.count("\n") == 1
    result = json.loads(done.stdout)
    assert [(r["asset"], r["status"]) for r in result["assets"]] == [
        ("a.ply", "built"),
        ("b.ply", "failed"),
        ("c.ply", "built"),
    ]
    assert "b.ply" in result["assets"][1]["error"]
    assert (result["built"], result["kept"], result["failed"]) == (2, 0, 1)
    assert sorted(os.listdir(folder)) == [
        "a.ply",
        "a.v3dg",
        "b.ply",
        "c.ply",
        "c.v3dg",
        "notes.txt",
    ]


def test_bundles_go_to_the_output_folder_and_are_those_of_single_builds(folder):
    (folder / "b.ply").unlink()
    done = run("build", "a.ply", "c.ply", "-o", "new/out", *FAST, cwd=folder)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1].startswith("2 built, 0 kept, 0 failed, ")
    assert sorted(os.listdir(folder / "new" / "out")) == ["a.v3dg", "c.v3dg"]
    assert run("build", "c.ply", *FAST, cwd=folder).returncode == 0
    assert (folder / "c.v3dg").read_bytes() == (folder / "new" / "out" / "c.v3dg").read_bytes()


def test_bundles_that_exist_are_replaced_only_if_asked(folder):
    (folder / "b.ply").unlink()
    (folder / "c.v3dg").write_text("mine")
    done = run("build", ".", *FAST, cwd=folder)
    assert done.returncode == 2
    assert "c.v3dg: already exists; --resume keeps" in done.stderr
    assert not (folder / "a.v3dg").exists()
    assert (folder / "c.v3dg").read_text() == "mine"
    assert run("build", ".", *FAST, "--overwrite", cwd=folder).returncode == 0
    assert len(v3dg.open(folder / "c.v3dg").clusters) > 1


def test_resume_keeps_what_is_done_with_these_settings(folder):
    (folder / "b.ply").unlink()

    def statuses(*options):
        done = run("build", ".", *FAST, "--resume", "--json", *options, cwd=folder)
        assert done.returncode == 0, done.stderr
        return [r["status"] for r in json.loads(done.stdout)["assets"]]

    assert statuses() == ["built", "built"]
    assert statuses() == ["kept", "kept"]
    assert statuses("--seed", 1) == ["built", "built"]
    # The dates of files must not matter, so some files with other gaussians get dates
    # before those of their bundles, and some with the same gaussians get later ones.
    (folder / "a.ply").rename(folder / "b.ply")
    (folder / "c.ply").rename(folder / "a.ply")
    (folder / "b.ply").rename(folder / "c.ply")
    os.utime(folder / "a.ply", ns=(0, 0))
    assert statuses("--seed", 1) == ["built", "built"]
    soon = time.time_ns() + 10**9
    os.utime(folder / "a.ply", ns=(soon, soon))
    (folder / "c.v3dg").write_bytes(b"cut off")
    assert statuses("--seed", 1) == ["kept", "built"]


def test_resume_needs_no_format(folder):
    """Files with the same gaussians in different formats are the same asset."""
    assert run("build", "a.ply", "-o", "out.v3dg", *FAST, cwd=folder).returncode == 0
    v3dg.write_asset(folder / "ascii.ply", v3dg.read_asset(folder / "a.ply"), encoding="ascii")
    done = run("build", "ascii.ply", "-o", "out.v3dg", *FAST, "--resume", "--json", cwd=folder)
    assert json.loads(done.stdout)["status"] == "kept"


def lies(config):
    return [
        {},
        {"note": "of another program"},
        config | {"dropped": 5},
        config | {"dropped": {"a\nb": 1}},
        config | {"dropped": None},
        config | {"dropped": {"transparent": "many"}},
        config | {"asset_gaussians": [1]},
        config | {"asset_gaussians": -1},
        config | {"asset_digest": 0},
        config | {"build": []},
        config | {"seed": {}},
        # Older versions built bundles without these entries.
        {name: value for name, value in config.items() if name != "asset_digest"},
    ]


def test_resume_builds_over_a_bundle_whose_config_lies(folder):
    output = folder / "a.v3dg"
    options = {
        "config": v3dg.BuildConfig(cluster_size=64, steps=1),
        "progress": False,
        "quality": "draft",
    }
    bundle, _ = build_file(folder / "a.ply", output, **options)
    whole = output.read_bytes()
    for config in lies(bundle.config):
        v3dg.Bundle(bundle.clusters, bundle.groups, bundle.gaussians, config).write(output)
        assert v3dg.Bundle.open(output).config == config
        assert build_file(folder / "a.ply", output, resume=True, **options)[1], config
        assert output.read_bytes() == whole
    v3dg.Bundle(
        bundle.clusters, bundle.groups, bundle.gaussians, bundle.config | {"dropped": 5}
    ).write(output)
    done = run("build", "a.ply", *FAST, "--resume", "--json", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["status"] == "built"


def test_strict_refuses_also_what_resume_would_keep(folder):
    asset = v3dg.read_asset(folder / "a.ply")
    asset.opacities[0] = np.nan
    v3dg.write_asset(folder / "bad.ply", asset)
    assert run("build", "bad.ply", *FAST, cwd=folder).returncode == 0
    fails(
        1,
        "bad.ply: asset: expected only gaussians",
        "build",
        "bad.ply",
        *FAST,
        "--resume",
        "--strict",
        cwd=folder,
    )


def test_an_interrupt_says_how_far_it_got(folder):
    (folder / "b.ply").unlink()
    v3dg.write_asset(folder / "b.ply", make_asset(60_000))
    process = subprocess.Popen(
        [*COMMAND, "build", ".", "--cluster-size", "64"],
        cwd=folder,
        stderr=subprocess.PIPE,
        env=ENVIRONMENT,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    lines = iter(process.stderr.readline, "")
    assert any(line.startswith("[2/3] b.ply") for line in lines)
    time.sleep(1)
    process.send_signal(signal.SIGINT)
    _, rest = process.communicate(timeout=60)
    assert process.returncode == 130
    message = "v3dg: error: interrupted with 1 of 3 assets done; `--resume` continues"
    assert rest.splitlines()[-1] == message
    assert (folder / "a.v3dg").exists()
    assert not (folder / "b.v3dg").exists()


def test_errors_before_anything_is_built(folder):
    fails(2, "PATH: expected at least one asset", "build", cwd=folder)
    (folder / "empty").mkdir()
    fails(1, "empty: expected a folder with assets (.ply", "build", "empty", cwd=folder)
    v3dg.write_asset(folder / "empty" / "a.ply", tiny())
    message = "out/a.v3dg: expected one asset for this bundle, got a.ply and empty/a.ply"
    (folder / "out").mkdir()
    fails(1, message, "build", "a.ply", "empty", "-o", "out", cwd=folder)


def test_several_files_make_one_asset(tmp_path):
    """This also holds with little memory, and if only the folder of the files is
    given."""
    parts = [tiny(), tiny()]
    (tmp_path / "tiles").mkdir()
    for name, part in zip("ab", parts, strict=True):
        v3dg.write_asset(tmp_path / "tiles" / f"{name}.ply", part)
    done = run(
        "build", "tiles/a.ply", "tiles/b.ply", "-o", "city.v3dg", *FAST, "--json", cwd=tmp_path
    )
    result = json.loads(done.stdout)
    assert result["asset"] == ["tiles/a.ply", "tiles/b.ply"]
    assert result["asset_gaussians"] == sum(map(len, parts))
    assert (
        run(
            "build", "tiles", "-o", "again.v3dg", *FAST, "--memory", "1GiB", cwd=tmp_path
        ).returncode
        == 0
    )
    assert (tmp_path / "city.v3dg").read_bytes() == (tmp_path / "again.v3dg").read_bytes()
    for amount, message in (
        ("much", "expected a positive number of bytes, or text like '8GiB', got 'much'"),
        ("1", "expected at least 7"),
    ):
        fails(
            1,
            f"memory: {message}",
            "build",
            "tiles",
            "-o",
            "x.v3dg",
            "--memory",
            amount,
            cwd=tmp_path,
        )


def test_an_asset_larger_than_memory_makes_the_same_bundle(tmp_path, monkeypatch):
    from v3dg.levels import leaves_on_disk

    asset = make_asset(num_gaussians=3000, seed=1)
    v3dg.write_asset(tmp_path / "a.ply", asset)
    options = {"config": v3dg.BuildConfig(steps=2, num_views=2), "progress": False, "device": "cpu"}
    build_file(tmp_path / "a.ply", tmp_path / "whole.v3dg", **options)
    sizes = leaves_on_disk._Sizes(in_memory=100, in_block=1 << 16, in_node=700, in_bucket=300)
    monkeypatch.setattr(leaves_on_disk._Sizes, "of", lambda *_: sizes)
    monkeypatch.setattr("v3dg.levels.whole.UNIT_LEAVES", 1 << 20)
    build_file(tmp_path / "a.ply", tmp_path / "disk.v3dg", **options)
    assert (tmp_path / "disk.v3dg").read_bytes() == (tmp_path / "whole.v3dg").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.ply", "disk.v3dg", "whole.v3dg"]


def gsplat_checkpoint(path, asset):
    torch = pytest.importorskip("torch")
    path.parent.mkdir(parents=True, exist_ok=True)
    names = ("means", "quats", "scales", "opacities")
    splats = {name: torch.from_numpy(getattr(asset, name).copy()) for name in names}
    splats["scales"] = splats["scales"].log()
    splats["opacities"] = splats["opacities"].clamp(1e-3, 1 - 1e-3).logit()
    sh = torch.from_numpy(asset.sh.copy())
    torch.save({"splats": splats | {"sh0": sh[:, :1], "shN": sh[:, 1:]}}, path)


def test_a_run_of_gsplat_is_one_asset_of_its_last_step(tmp_path):
    parts = [tiny(1), tiny(2)]
    gsplat_checkpoint(tmp_path / "garden" / "ckpts" / "ckpt_6999_rank0.pt", tiny(3))
    for rank, part in enumerate(parts):
        gsplat_checkpoint(tmp_path / "garden" / "ckpts" / f"ckpt_29999_rank{rank}.pt", part)
    done = run("build", "garden", *FAST, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["asset"] == [f"garden/ckpts/ckpt_29999_rank{rank}.pt" for rank in (0, 1)]
    assert (
        result["asset_gaussians"]
        == v3dg.open(tmp_path / "garden.v3dg").config["asset_gaussians"]
        == 600
    )


@pytest.mark.parametrize(
    ("last", "before"),
    [
        ("nerfstudio_models/step-000029999.ckpt", "nerfstudio_models/step-000002000.ckpt"),
        (
            "point_cloud/iteration_30000/point_cloud.ply",
            "point_cloud/iteration_7000/point_cloud.ply",
        ),
    ],
)
def test_the_last_step_of_a_run_counts(tmp_path, last, before):
    for name in (last, before):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert run_files(tmp_path) == [tmp_path / last]


def test_several_runs_are_bundles_named_after_them(tmp_path):
    for name in ("first", "second.run"):
        file = tmp_path / name / "point_cloud" / "iteration_30000" / "point_cloud.ply"
        file.parent.mkdir(parents=True)
        v3dg.write_asset(file, tiny(len(name)))
    done = run("build", "first", "second.run", "-o", "out", *FAST, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert sorted(os.listdir(tmp_path / "out")) == ["first.v3dg", "second.run.v3dg"]
    assert run("build", ".", *FAST, cwd=tmp_path / "first").returncode == 0
    assert (tmp_path / "first.v3dg").read_bytes() == (tmp_path / "out" / "first.v3dg").read_bytes()
