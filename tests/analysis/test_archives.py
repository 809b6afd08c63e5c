"""An archive is unpacked only if there is room for it, whatever it says of itself."""

import io
import tracemalloc
import zipfile

import pytest

from recrl.analysis.data.archives import METHODS, UNREADABLE, unpacked


def packed(members: dict[str, bytes], method: int) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", method) as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    return data.getvalue()


@pytest.mark.parametrize("method", METHODS)
def test_members_come_in_the_order_that_was_asked_for(method: int) -> None:
    members = {"a": b"first" * 3000, "b": b"", "c": bytes(range(256)) * 100}
    with zipfile.ZipFile(io.BytesIO(packed(members, method))) as archive:
        assert unpacked(archive, ("c", "a", "b"), max_bytes=40_600) == [members[name] for name in "cab"]
        with pytest.raises(ValueError, match="it unpacks to 40600 bytes, at most 40599 are taken"):
            unpacked(archive, ("c", "a", "b"), max_bytes=40_599)
        with pytest.raises(UNREADABLE, match="no item named 'd'"):
            unpacked(archive, ("d",), max_bytes=0)


def test_an_archive_that_lies_about_its_size_takes_little_room() -> None:
    size = 64 * 2**20
    data = packed({"bomb": bytes(size)}, zipfile.ZIP_DEFLATED)
    told = size.to_bytes(4, "little")
    assert data.count(told) == 2  # before the member, and in the directory behind all of them
    with zipfile.ZipFile(io.BytesIO(data.replace(told, (100).to_bytes(4, "little")))) as archive:
        tracemalloc.start()
        try:
            with pytest.raises(UNREADABLE, match="Bad CRC-32"):
                unpacked(archive, ("bomb",), max_bytes=1000)
            _, most = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    assert most < 2**20


def test_a_method_that_may_unpack_to_anything_is_refused() -> None:
    with (
        zipfile.ZipFile(io.BytesIO(packed({"a": b""}, zipfile.ZIP_BZIP2))) as archive,
        pytest.raises(ValueError, match="its members must be deflated or packed by LZMA"),
    ):
        unpacked(archive, ("a",), max_bytes=10)
