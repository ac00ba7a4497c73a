"""What is unpacked of an archive, and where to."""

import io
import tarfile

import pytest

from experiments.storage.archive import unpack


@pytest.fixture
def archive(tmp_path):
    path = tmp_path / "logs.tar.xz"
    with tarfile.open(path, "w:xz") as out:
        for name in ("best/config.json", "random/config.json"):
            member = tarfile.TarInfo(name)
            member.size = len(name)
            out.addfile(member, io.BytesIO(name.encode()))
    return path


def test_all_or_what_has_a_prefix_is_unpacked(archive, tmp_path):
    assert unpack(archive, tmp_path / "all")
    found = {x.relative_to(tmp_path).as_posix() for x in tmp_path.rglob("*.json")}
    assert found == {"all/best/config.json", "all/random/config.json"}
    assert unpack(archive, tmp_path / "some", "best/")
    assert [x.name for x in (tmp_path / "some").iterdir()] == ["best"]
    assert not unpack(archive, tmp_path / "none", "opax/")


@pytest.mark.skipif(not hasattr(tarfile, "data_filter"), reason="Python before 3.11.4")
def test_nothing_is_written_outside_of_the_folder(tmp_path):
    path = tmp_path / "odd.tar"
    with tarfile.open(path, "w") as out:
        out.addfile(tarfile.TarInfo("../odd"))
    with pytest.raises(tarfile.OutsideDestinationError):
        unpack(path, tmp_path / "folder")
    assert not (tmp_path / "odd").exists()
