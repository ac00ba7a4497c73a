"""Files are replaced at once: what a reader, a link and a killed process leave."""

import pytest

from experiments.errors import StorageError
from experiments.storage import disk


def test_a_reader_sees_the_old_file_or_the_new(tmp_path):
    path = tmp_path / "a.npz"
    path.write_text("old")
    with disk.replaced(path) as draft:
        draft.write_text("new")
        assert draft.suffix == ".npz" and path.read_text() == "old"
    assert path.read_text() == "new"
    with pytest.raises(KeyError), disk.replaced(path) as draft:
        draft.write_text("half")
        raise KeyError
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_is_replaced_and_not_followed(tmp_path):
    (tmp_path / "precious").write_text("data")
    (tmp_path / "a").symlink_to("precious")
    disk.write(tmp_path / "a", b"new")
    assert (tmp_path / "precious").read_text() == "data"
    assert (tmp_path / "a").read_text() == "new"


def test_what_a_disk_refuses_is_one_line(tmp_path):
    (tmp_path / "a").mkdir()
    with pytest.raises(StorageError, match=r"cannot write .*/a \("):
        disk.write(tmp_path / "a", b"new")
    with pytest.raises(StorageError, match=r"cannot write .*/b/c \(No such file"):
        disk.write(tmp_path / "b" / "c", b"new")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_a_new_folder_is_on_the_disk(tmp_path, monkeypatch):
    synced = []
    monkeypatch.setattr(disk, "sync", synced.append)
    disk.make(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir() and set(synced) == {tmp_path, tmp_path / "a"}
    disk.make(tmp_path / "a" / "b")
    assert len(synced) == 2


def test_drafts_of_the_killed_are_swept(tmp_path):
    (tmp_path / ".tmp-0badcafe.npz").write_text("half")
    (tmp_path / "a").write_text("whole")
    (tmp_path / ".writing-0badcafe").mkdir()
    (tmp_path / ".writing-0badcafe" / "policy.safetensors").write_text("half")
    disk.sweep(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
