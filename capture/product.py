"""Products of stages: written under a temporary name, renamed, with a record of their making."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

_CHUNK = 1 << 20
_SEAL = "product_sha256"
_SOURCES = {".py", ".glsl"}
_FLOORS = ("capture", "recon", "track", "rig")  # lowest first; names only, nothing is imported


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path beside `path`; rename it on success, remove it on any failure.

    The temporary name keeps the suffix of `path`, so that writers which choose a format by suffix
    work. It may be filled with a file or with a folder. Nothing half-written is ever left, Ctrl-C
    included; a product that stood at `path` stays until the new one is whole.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".partial-{os.getpid()}-{path.name}")
    _remove(partial)
    try:
        yield partial
        if partial.is_dir() and path.exists():
            old = path.with_name(f".old-{os.getpid()}-{path.name}")
            path.replace(old)
            try:
                partial.replace(path)
            except BaseException:
                old.replace(path)
                raise
            _remove(old)
        else:
            partial.replace(path)
    except BaseException:
        _remove(partial)
        raise


def hash_file(path: Path) -> str:
    """SHA-256 of a file's bytes, as hex."""
    digest = hashlib.sha256()
    with Path(path).open("rb") as handle:
        while block := handle.read(_CHUNK):
            digest.update(block)
    return digest.hexdigest()


def stage_record(stage: str, settings: Any, inputs: Mapping[str, str]) -> dict[str, Any]:
    """What makes a product what it is: stage, code version, resolved settings, input hashes.

    The code version ends in a digest of the sources of the stage's floor and of those below it, so
    that a change of the code is seen even where nobody raised the version.

    Args:
        stage: the stage's name.
        settings: a dataclass, or None.
        inputs: by name, the hash of each input.
    """
    plain = dataclasses.is_dataclass(settings) and not isinstance(settings, type)
    resolved = dataclasses.asdict(settings) if plain else None
    record = {
        "stage": stage,
        "code": f"{code_version()}+{_source_digest(_floor_of(settings))}",
        "settings": resolved,
        "inputs": dict(sorted(inputs.items())),
    }
    whole: dict[str, Any] = json.loads(json.dumps(record, default=str))
    return whole


def code_version() -> str:
    """The installed version of likeness."""
    try:
        return metadata.version("likeness")
    except metadata.PackageNotFoundError:
        return "uninstalled"


def is_current(product: Path, record: Mapping[str, Any]) -> bool:
    """Whether `product` was made exactly as `record` says, and is as it was then, byte for byte."""
    found = _sealed_record(product)
    return found is not None and {**found, _SEAL: None} == {**record, _SEAL: None}


def is_made_of(product: Path, inputs: Mapping[str, str]) -> bool:
    """Whether `product` is whole and was made of these inputs, whatever the settings and code."""
    found = _sealed_record(product)
    made_of = {} if found is None else found.get("inputs", {})
    return found is not None and all(made_of.get(key) == inputs[key] for key in inputs)


def write_record(product: Path, record: Mapping[str, Any]) -> None:
    """Write the record beside its product, which is a file, sealed with the hash of its bytes."""
    sealed = {**record, _SEAL: hash_file(product)}
    with replacing(record_path(product)) as partial:
        partial.write_text(json.dumps(sealed, indent=1) + "\n", encoding="utf-8")


def record_path(product: Path) -> Path:
    """Where the record of a product stands: `frame_0000.ply` -> `frame_0000.ply.record.json`."""
    return Path(product).with_name(Path(product).name + ".record.json")


def _sealed_record(product: Path) -> dict[str, Any] | None:
    """The record beside a product whose bytes are still those it was sealed with."""
    beside = record_path(product)
    if not Path(product).is_file() or not beside.exists():
        return None
    try:
        found = json.loads(beside.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    whole = isinstance(found, dict) and found.get(_SEAL) == hash_file(product)
    return found if whole else None


def _floor_of(settings: Any) -> str:
    top = type(settings).__module__.partition(".")[0]
    return top if top in _FLOORS else _FLOORS[-1]


@functools.cache
def _source_digest(floor: str) -> str:
    digest = hashlib.sha256()
    house = Path(__file__).resolve().parents[1]
    for name in _FLOORS[: _FLOORS.index(floor) + 1]:
        for path in sorted(p for p in (house / name).rglob("*") if p.suffix in _SOURCES):
            digest.update(path.relative_to(house).as_posix().encode() + b"\0")
            digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
