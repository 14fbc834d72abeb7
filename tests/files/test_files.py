"""How all writers treat existing files and links. test_malformed.py tests failures."""

import os
import stat

import pytest

import v3dg
from test_malformed import (
    ASSET,
    WRITERS,
    assert_refused,
    let_others_look,
    without_privileges,
)
from v3dg._files import replacing

EVERY_WRITER = WRITERS | {"sog": ("a.sog", lambda path: v3dg.write_asset(path, ASSET))}
some_writer = pytest.mark.parametrize("writer", EVERY_WRITER)


def mode_of(path):
    return stat.S_IMODE(os.stat(path).st_mode)


@some_writer
@pytest.mark.parametrize("mode", [0o600, 0o640, 0o664, 0o755, 0o200])
def test_what_is_replaced_keeps_its_permissions(tmp_path, writer, mode):
    name, write = EVERY_WRITER[writer]
    path = tmp_path / name
    path.touch()
    path.chmod(mode)
    write(path)
    assert path.stat().st_size > 0
    assert mode_of(path) == mode


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_what_is_replaced_keeps_its_owner(tmp_path):
    path = tmp_path / "a.ply"
    path.touch()
    os.chown(path, 65534, 65533)
    v3dg.write_asset(path, ASSET)
    assert (path.stat().st_uid, path.stat().st_gid) == (65534, 65533)


def test_nobody_may_read_a_private_file_before_it_is_there(tmp_path):
    path = tmp_path / "private"
    path.touch()
    path.chmod(0o640)
    with replacing(path) as temporary:
        assert mode_of(temporary) == 0o600
    assert mode_of(path) == 0o640


@some_writer
def test_a_file_that_may_not_be_written_is_refused(tmp_path, writer):
    name, write = EVERY_WRITER[writer]
    path = tmp_path / name
    path.write_bytes(b"before")
    path.chmod(0o444)
    let_others_look(tmp_path)
    tmp_path.chmod(0o777)
    with without_privileges():
        assert_refused(write, path)
    assert path.read_bytes() == b"before"
    assert os.listdir(tmp_path) == [name]


@some_writer
@pytest.mark.parametrize("is_there", [True, False])
def test_a_link_stays_a_link(tmp_path, writer, is_there):
    name, write = EVERY_WRITER[writer]
    (tmp_path / "elsewhere").mkdir()
    target = tmp_path / "elsewhere" / "target"
    if is_there:
        target.touch()
    (tmp_path / name).symlink_to(target)
    write(tmp_path / name)
    assert (tmp_path / name).is_symlink()
    assert target.stat().st_size > 0
    assert os.listdir(tmp_path / "elsewhere") == ["target"]


@some_writer
def test_links_that_lead_nowhere_are_refused(tmp_path, writer):
    name, write = EVERY_WRITER[writer]
    (tmp_path / name).symlink_to(name)
    assert_refused(write, tmp_path / name)
    (tmp_path / name).unlink()
    (tmp_path / name).symlink_to("absent/target")
    assert_refused(write, tmp_path / name)
    assert os.listdir(tmp_path) == [name]


def test_a_link_at_the_temporary_name_is_not_followed(tmp_path, monkeypatch):
    victim = tmp_path / "victim"
    victim.write_bytes(b"before")
    monkeypatch.setattr("secrets.token_hex", lambda _: "guessed")
    for target in (victim, tmp_path / "absent"):
        os.symlink(target, tmp_path / ".a.bin.guessed.tmp")
        with pytest.raises(FileExistsError, match=r"a\.bin"), replacing(tmp_path / "a.bin"):
            pass
        (tmp_path / ".a.bin.guessed.tmp").unlink()
    assert victim.read_bytes() == b"before"
    assert not (tmp_path / "absent").exists()
