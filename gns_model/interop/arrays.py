"""Arrays out of an npz of object arrays, whose pickles are read without running anything.

NumPy stores an object array as a pickle, and loading a pickle can call whatever it names. Here it
can name the few functions by which NumPy rebuilds arrays and gets stand-ins for these: they note
what they were asked for, check it, and only then is an array made, from plain bytes.
Python's own unpickler is used, not the one in C, because a hostile file could crash the latter.
"""

from __future__ import annotations

import math
import os
import pickle
import zipfile
from collections.abc import Iterator
from typing import IO, Any

import numpy as np

from gns_model.errors import FileFormatError

#: Types of numbers that an array may hold, as pickles call them.
NUMBERS = {"b1", "f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8"}

#: Object arrays hold tuples of arrays; more levels than that are not data.
DEPTH = 6


class Refused(Exception):
    """A pickle that asks for something other than arrays, numbers, lists and tuples."""


def read_npz(path: str | os.PathLike[str]) -> Iterator[tuple[str, Any]]:
    """Names and contents of an npz, one after the other; only one is in memory.

    Yields:
        name and array. In an object array every element is an array, a number, or a list or tuple
        of such.

    Raises:
        FileFormatError: one line, if the file is missing, truncated or foreign, or if a pickle in
            it asks for anything but arrays; nothing that it names is run or imported.
    """
    name = ""
    try:
        with zipfile.ZipFile(path) as archive:
            for member in archive.infolist():
                name = member.filename.removesuffix(".npy")
                with archive.open(member) as stream:
                    yield name, _read_npy(stream)
    except Refused as error:
        raise FileFormatError(f"{path}: {name!r} is refused: {error}") from None
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (GeneratorExit, MemoryError):
        raise
    except Exception:  # a damaged file or hostile pickle raises nearly anything
        where = f"{name!r} is " if name else ""
        raise FileFormatError(f"{path}: {where}truncated, or not an npz of arrays") from None


def count_npz(path: str | os.PathLike[str]) -> int:
    """Number of arrays in an npz.

    Raises:
        FileFormatError: if it is missing, truncated or foreign.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return len(archive.infolist())
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read ({error.strerror or error})") from None
    except Exception:
        raise FileFormatError(f"{path}: truncated, or not an npz") from None


def _read_npy(stream: IO[bytes]) -> np.ndarray:
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    elif version == (2, 0):
        shape, fortran, dtype = np.lib.format.read_array_header_2_0(stream)
    else:
        raise Refused(f"its npy version is {version}")
    if not dtype.hasobject:
        if dtype.kind not in "biuf":
            raise Refused(f"it holds {dtype}, not numbers")
        return _from_bytes(stream.read(), dtype, shape, fortran)
    content = _Unpickler(stream).load()
    if not isinstance(content, _Array):
        raise Refused("its pickle holds no array")
    return _resolved(content, {}, DEPTH)


def _from_bytes(
    raw: bytes | bytearray, dtype: np.dtype, shape: tuple[int, ...], fortran: bool
) -> np.ndarray:
    if not all(type(n) is int and n >= 0 for n in shape):
        raise Refused(f"an array in it has shape {shape!r:.40}")
    if len(raw) != math.prod(shape) * dtype.itemsize:
        raise Refused(f"{len(raw)} bytes do not fill an array of shape {shape} of {dtype}")
    return np.frombuffer(raw, dtype).reshape(shape, order="F" if fortran else "C")


class _Dtype:
    """Stand-in for a dtype: a type of numbers, or None for objects (and records of objects)."""

    __slots__ = ("number",)

    def __init__(self, name: Any, *_options: Any) -> None:
        if name in NUMBERS:
            self.number: np.dtype | None = np.dtype(name)
        elif isinstance(name, str) and name[:1] in ("O", "V"):
            self.number = None
        else:
            raise Refused(f"it holds {str(name)[:40]!r}, not numbers")

    def __setstate__(self, state: Any) -> None:
        _version, order, subarray, *_rest = state
        if order not in ("<", ">", "|", "=") or subarray is not None:
            raise Refused("it holds an odd dtype")
        if self.number is not None and order != "|":
            self.number = self.number.newbyteorder(order)


class _Array:
    """Stand-in for an array: `content` is an array of numbers, or a list of objects."""

    __slots__ = ("content", "fortran", "shape")

    def __init__(self) -> None:
        self.content: np.ndarray | list | None = None
        self.shape: tuple[int, ...] = ()
        self.fortran = False

    def __setstate__(self, state: Any) -> None:
        _version, self.shape, dtype, self.fortran, raw = state
        if type(self.shape) is not tuple or not isinstance(dtype, _Dtype):
            raise Refused("an array in it is malformed")
        if dtype.number is not None and isinstance(raw, bytes | bytearray):
            self.content = _from_bytes(raw, dtype.number, self.shape, bool(self.fortran))
        elif dtype.number is None and type(raw) is list:
            if not all(type(n) is int and n >= 0 for n in self.shape) or (
                math.prod(self.shape) != len(raw)
            ):
                raise Refused(f"{len(raw)} objects do not fill an array of shape {self.shape}")
            self.content = raw
        else:
            raise Refused("an array in it is malformed")


class _Function:
    """What a pickle gets in place of a function: can be called, and nothing else."""

    __slots__ = ("_call",)

    def __init__(self, call: Any) -> None:
        self._call = call

    def __call__(self, *arguments: Any) -> Any:
        return self._call(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise Refused("it tries to change a function")


def _reconstruct(_kind: Any, _shape: Any, _dtype: Any) -> _Array:
    return _Array()


def _scalar(dtype: Any, raw: Any) -> Any:
    if not isinstance(dtype, _Dtype) or dtype.number is None or not isinstance(raw, bytes):
        raise Refused("a number in it is malformed")
    return _from_bytes(raw, dtype.number, (), False)[()].item()


def _from_buffer(raw: Any, dtype: Any, shape: Any, order: Any, axes: Any = None) -> _Array:
    array = _Array()
    if axes is not None:
        raise Refused("an array in it is malformed")
    array.__setstate__((1, shape, dtype, order == "F", raw))
    return array


def _latin(text: Any, encoding: Any) -> bytes:
    """How protocol 2 writes bytes."""
    if type(text) is not str or encoding != "latin1":
        raise Refused("bytes in it are malformed")
    return text.encode("latin1")


def _empty(*arguments: Any) -> bytes:
    """How protocol 2 writes no bytes."""
    if arguments:
        raise Refused("bytes in it are malformed")
    return b""


def _nothing(*_arguments: Any) -> Any:
    raise Refused("it calls numpy.ndarray")


#: What a pickle may name. NumPy 1 says `core`, NumPy 2 `_core`.
ALLOWED = {
    ("numpy", "dtype"): _Dtype,
    ("numpy", "ndarray"): _nothing,  # only ever an argument
    ("_codecs", "encode"): _latin,
    ("builtins", "bytes"): _empty,
    ("__builtin__", "bytes"): _empty,
    **{
        (f"numpy.{core}.{module}", name): call
        for core in ("core", "_core")
        for module, name, call in (
            ("multiarray", "_reconstruct", _reconstruct),
            ("multiarray", "scalar", _scalar),
            ("numeric", "_frombuffer", _from_buffer),
        )
    },
}


class _Unpickler(pickle._Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in ALLOWED:
            raise Refused(f"its pickle asks for {module}.{name}, which is no array"[:120])
        return _Function(ALLOWED[module, name])

    def get_extension(self, code: int) -> Any:
        raise Refused("its pickle asks for a registered extension")

    def persistent_load(self, pid: Any) -> Any:
        raise Refused("its pickle asks for a persistent object")


def _resolved(value: Any, known: dict[int, Any], depth: int) -> Any:
    """Stand-ins replaced by arrays; `known` keeps what many places refer to from being repeated."""
    if isinstance(value, bool | int | float):
        return value
    if depth == 0 or not isinstance(value, _Array | list | tuple):
        raise Refused(f"it holds a {type(value).__name__} where arrays belong")
    if id(value) in known:
        return known[id(value)]
    if not isinstance(value, _Array):
        found: Any = type(value)(_resolved(v, known, depth - 1) for v in value)
    elif isinstance(value.content, list):
        found = np.empty(len(value.content), dtype=object)
        for k, element in enumerate(value.content):
            found[k] = _resolved(element, known, depth - 1)
        found = found.reshape(value.shape, order="F" if value.fortran else "C")
    elif value.content is None:
        raise Refused("an array in it is malformed")
    else:
        found = value.content
    known[id(value)] = found
    return found
