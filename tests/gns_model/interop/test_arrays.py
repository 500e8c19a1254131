"""Object arrays are read as NumPy reads them; hostile pickles are refused before anything runs."""

from __future__ import annotations

import contextlib
import io
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gns_model.errors import FileFormatError
from gns_model.interop.arrays import count_npz, read_npz
from gns_model.interop.export import object_array


def objects(*parts: Any) -> np.ndarray:
    array = np.empty(len(parts), dtype=object)
    for k, part in enumerate(parts):
        array[k] = part
    return array


def write(path: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return path


def npy(pickled: bytes) -> bytes:
    """An npy file of one object whose pickle is `pickled`."""
    file = io.BytesIO()
    header = {"descr": "|O", "fortran_order": False, "shape": (1,)}
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue() + pickled


def read_one(path: Path) -> Any:
    ((_, content),) = read_npz(path)
    return content


NUMBERS = st.sampled_from(["<f4", ">f8", "<f2", "|b1", "<i8", ">i4", "|u1"])


@given(
    first=hnp.arrays(NUMBERS.map(np.dtype), hnp.array_shapes(min_dims=0, max_dims=3, min_side=0)),
    second=st.one_of(st.integers(), st.floats(), st.booleans(), st.just(np.float32(0.7))),
    protocol=st.integers(2, 5),
    fortran=st.booleans(),
)
def test_what_numpy_wrote_is_read(tmp_path, first, second, protocol, fortran):
    if fortran:
        first = np.asfortranarray(first)
    content = objects(first, (second, [first]), objects(second, first))
    write(tmp_path / "a.npz", {"x": npy(pickle.dumps(content, protocol=protocol))})
    found = read_one(tmp_path / "a.npz")
    np.testing.assert_array_equal(found[0], first)
    assert found[0].dtype == first.dtype
    assert isinstance(found[1], tuple)
    np.testing.assert_equal(found[1][0], second)
    np.testing.assert_array_equal(found[1][1][0], first)
    np.testing.assert_array_equal(found[2][1], first)


def test_savez_compressed_with_names_of_either_numpy(tmp_path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, a=objects(np.arange(6.0).reshape(1, 3, 2), 6), b=np.eye(3))
    names, contents = zip(*read_npz(path), strict=True)
    assert names == ("a", "b")
    assert count_npz(path) == 2
    np.testing.assert_array_equal(contents[1], np.eye(3))
    for core in (b"core", b"_core"):
        raw = object_array([np.arange(3), 6])
        assert raw.count(b"numpy.core.multiarray") == 1
        write(path, {"x": raw.replace(b"cnumpy.core.", b"cnumpy." + core + b".")})
        np.testing.assert_array_equal(read_one(path)[0], np.arange(3))


def test_object_arrays_that_we_write_are_read_by_numpy(tmp_path):
    path = write(tmp_path / "a.npz", {"x": object_array([np.ones((2, 3, 2), np.float32), 6])})
    with np.load(path, allow_pickle=True) as file:
        assert file["x"].dtype == object
        np.testing.assert_array_equal(file["x"][0], np.ones((2, 3, 2)))
        assert file["x"][1] == 6


def test_records_and_an_array_that_numpy_broke_up(tmp_path):
    path = tmp_path / "a.npz"
    record = np.empty(2, dtype=[("positions", object), ("particle_type", object)])
    for k in range(2):
        record[k] = (np.full((3, 2, 2), k, float), 6)
    square = np.empty((2, 3), dtype=object)  # what NumPy makes of (3, 2, 2) floats and (3,) types
    for t in range(3):
        square[0, t], square[1, t] = np.zeros((2, 2)), 6
    np.savez(path, r=record, s=square)
    (_, found), (_, broken) = read_npz(path)
    np.testing.assert_array_equal(found[1][0], np.ones((3, 2, 2)))
    assert found[1][1] == 6
    assert broken.shape == (2, 3)


# -- hostile files -------------------------------------------------------------------------------


class Calls:
    """Pickles as a call of `function`."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> Any:
        return self.call


def raw(text: str) -> bytes:
    return text.encode("latin1")


HOSTILE = {
    "os.system": raw("cposix\nsystem\n(S'touch was-run'\ntR."),
    "os.system by its front": raw("cos\nsystem\n(S'touch was-run'\ntR."),
    "eval": raw('cbuiltins\neval\n(S\'open("was-run","w")\'\ntR.'),
    "eval of Python 2": raw('c__builtin__\neval\n(S\'open("was-run","w")\'\ntR.'),
    "through numpy's testing": raw("cnumpy.testing._private.utils\nrunstring\n(S'1'\n}tR."),
    "numpy.load, with pickles": raw("cnumpy\nload\n(S'was-run'\nNI01\ntR."),
    "numpy.fromfile": raw("cnumpy\nfromfile\n(S'/etc/hostname'\ntR."),
    "numpy.memmap": raw("cnumpy\nmemmap\n(S'was-run'\nS'uint8'\nS'w+'\nI0\n(I4\nttR."),
    "a dotted name": b"\x80\x04\x8c\x05numpy\x8c\x10ndarray.__init__\x93(tR.",
    "getattr": raw("cbuiltins\ngetattr\n(cnumpy\ndtype\nS'__init__'\ntR."),
    "ndarray called": raw("cnumpy\nndarray\n((I3\ntS'O'\ntR."),
    "an old instance": raw("(S'touch was-run'\niposix\nsystem\n."),
    "an object of a class": raw("(cposix\nsystem\nS'touch was-run'\no."),
    "an extension": b"\x80\x02\x82\x01.",
    "a persistent name": raw("Pwas-run\n."),
    "state for a function": b"\x80\x02cnumpy\ndtype\n}U\x08__code__K\x01sb.",
    "state for a function's slots": b"\x80\x02cnumpy\ndtype\nN}U\x05_callK\x01s\x86b.",
    "a dtype of its own making": raw(
        "cnumpy\ndtype\n(S'f8'\nI0\nI1\ntR(I3\nS'<'\nS'x'\nNNI9\nI9\nI0\ntb."
    ),
    "no array": pickle.dumps({"a": 1}),
    "bytes": pickle.dumps(objects(b"abc")),
    "strings": pickle.dumps(objects("abc")),
    "a callable in an array": pickle.dumps(objects(print)),
    "a call in an array": pickle.dumps(objects(Calls(Path.touch, Path("was-run")))),
    "a short buffer": pickle.dumps(objects(np.zeros(4))).replace(b"K\x04\x85", b"K\x05\x85"),
    "itself": b"\x80\x02]q\x00h\x00a.",
    "nothing": b"",
    "a huge memo": b"\x80\x02]r\xff\xff\xff\x7f.",
}


@pytest.mark.parametrize("pickled", HOSTILE.values(), ids=HOSTILE.keys())
def test_nothing_is_run_and_one_line_says_so(tmp_path, monkeypatch, pickled):
    monkeypatch.chdir(tmp_path)
    inner = pickle.dumps(objects(0, 1), protocol=2)
    for content in (pickled, inner[:-1] + b"0" + pickled):  # alone, and after a good array
        write(Path("a.npz"), {"good": npy(pickle.dumps(objects(1))), "bad": npy(content)})
        with pytest.raises(FileFormatError, match=r"a\.npz.*'bad'") as caught:
            list(read_npz("a.npz"))
        assert "\n" not in str(caught.value)
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]


def test_numpy_itself_would_have_run_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(Path("a.npz"), {"bad": npy(HOSTILE["os.system"])})
    with np.load("a.npz", allow_pickle=True) as file:
        _ = file["bad"]
    assert Path("was-run").exists()


def test_shared_parts_do_not_explode(tmp_path):
    value: Any = objects(1, 2)
    for _ in range(4):
        value = objects(*[value] * 3000)
    write(tmp_path / "a.npz", {"x": npy(pickle.dumps(value))})
    found = read_one(tmp_path / "a.npz")  # 3000⁴ entries, were they copied
    assert found[0] is found[2999]


def test_every_cut_of_a_file_is_refused_or_read(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, a=objects(np.zeros((2, 2, 2), np.float32), 6))
    whole = path.read_bytes()
    for keep in range(0, len(whole), 7):
        path.write_bytes(whole[:keep])
        with pytest.raises(FileFormatError, match=r"a\.npz"):
            list(read_npz(path))
    good = npy(pickle.dumps(objects(np.zeros((2, 2)), 6)))
    for keep in range(len(good)):
        write(path, {"x": good[:keep]})
        with pytest.raises(FileFormatError, match=r"a\.npz"):
            list(read_npz(path))
    with pytest.raises(FileFormatError, match="cannot be read"):
        list(read_npz(tmp_path / "nowhere.npz"))
    with pytest.raises(FileFormatError, match="cannot be read"):
        count_npz(tmp_path / "nowhere.npz")


@given(st.data())
def test_a_flipped_byte_never_escapes(tmp_path, data):
    good = bytearray(npy(pickle.dumps(objects(np.arange(4.0), 6, (1, [2.0])))))
    place = data.draw(st.integers(0, len(good) - 1))
    good[place] = data.draw(st.integers(0, 255))
    write(tmp_path / "a.npz", {"x": bytes(good)})
    with contextlib.suppress(FileFormatError):
        read_one(tmp_path / "a.npz")
