"""Arrays by name in one file of safetensors: no pickle, so that it can do nothing."""

import importlib
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, cast

import jax
import numpy as np

# As safetensors names what is kept here.
_DTYPES = {
    "F32": "float32", "F16": "float16", "I32": "int32", "U32": "uint32", "BOOL": "bool",
}  # fmt: skip


class TensorFile(NamedTuple):
    """What a file says it holds; arrays are read when `arrays` is called.

    Attributes:
      path: of the file.
      metadata: texts by name.
      shapes: of the arrays, by name.
      dtypes: of the arrays, by name.
    """

    path: Path
    metadata: dict[str, str]
    shapes: dict[str, tuple[int, ...]]
    dtypes: dict[str, str]

    def arrays(self) -> dict[str, np.ndarray]:
        """Reads all arrays."""
        with _opened(self.path) as file:
            return {name: file.get_tensor(name) for name in self.shapes}


def write(
    path: str | os.PathLike[str],
    arrays: Mapping[str, np.ndarray],
    metadata: Mapping[str, str],
) -> None:
    """Writes a file at once: whoever reads meanwhile finds the old one or the new one.

    Args:
      path: of the file; its folder must be there.
      arrays: float32, float16, int32, uint32 or bool.
      metadata: texts by name.

    Raises:
      FileNotFoundError: if its folder is not there.
      TypeError, ValueError: for a path that is none, or an array of another dtype.
    """
    target = _path(path)
    if not target.parent.is_dir():
        raise FileNotFoundError(
            f"path must be in a folder that is there, but {target.parent} is none."
        )
    rows = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    for name, row in rows.items():
        if str(row.dtype) not in _DTYPES.values():
            wanted = ", ".join(_DTYPES.values())
            raise ValueError(f"{name} must be of {wanted}, got {row.dtype}.")
    content = _safetensors("safetensors.numpy").save(rows, dict(metadata))
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".writing-") as folder:
        draft = Path(folder) / target.name
        draft.write_bytes(content)
        draft.replace(target)


def read(path: str | os.PathLike[str]) -> TensorFile:
    """Reads what a file says it holds, without its arrays.

    Raises:
      FileNotFoundError: if there is no such file.
      TypeError, ValueError: if path is none, it is no safetensors file, or has arrays
        of another dtype.
    """
    source = _path(path)
    if not source.is_file():
        raise FileNotFoundError(f"path must be a file, but {source} is none.")
    shapes: dict[str, tuple[int, ...]] = {}
    dtypes: dict[str, str] = {}
    with _opened(source) as file:
        for name in file.keys():  # noqa: SIM118
            part = file.get_slice(name)
            shapes[name], dtype = tuple(part.get_shape()), part.get_dtype()
            if dtype not in _DTYPES:
                wanted = ", ".join(_DTYPES)
                raise ValueError(
                    f"{name} of {source} must have a dtype of {wanted}, got {dtype}."
                )
            dtypes[name] = _DTYPES[dtype]
        return TensorFile(source, dict(file.metadata() or {}), shapes, dtypes)


def named(tree: Any) -> dict[str, Any]:
    """Returns the leaves of a pytree by their places in it, in its order."""
    leaves = cast(list[Any], jax.tree_util.tree_leaves_with_path(tree))
    return {jax.tree_util.keystr(p, simple=True, separator="."): x for p, x in leaves}


def _path(path: Any) -> Path:
    if not isinstance(path, (str, os.PathLike)):
        kind = type(path).__name__
        raise TypeError(f"path must be a text or a Path, got {path!r} ({kind}).")
    return Path(cast(Any, path))


def _opened(path: Path) -> Any:
    safetensors = _safetensors("safetensors")
    try:
        return safetensors.safe_open(path, framework="np")
    except safetensors.SafetensorError as error:
        raise ValueError(
            f"path must be a safetensors file, but {path} is none: {error}."
        ) from error


def _safetensors(module: str) -> Any:
    # Not before it is needed: all else of the library works without it.
    return importlib.import_module(module)
