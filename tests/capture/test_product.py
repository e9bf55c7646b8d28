"""Products are whole or absent, and their records say what they are made of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from capture.product import (
    hash_file,
    is_current,
    is_made_of,
    record_path,
    replacing,
    stage_record,
    write_record,
)


@dataclass(frozen=True)
class Knobs:
    strength: float = 1.0


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_failure_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, error: type[BaseException]
) -> None:
    path = tmp_path / "deep" / "thing.txt"
    with replacing(path) as partial:
        assert partial.suffix == ".txt"
        partial.write_text("old")

    def fail() -> None:
        with replacing(path) as partial:
            partial.write_text("half")
            raise error

    with pytest.raises(error):
        fail()
    assert path.read_text() == "old"
    assert [p.name for p in path.parent.iterdir()] == ["thing.txt"]


def test_folders_are_replaced_whole(tmp_path: Path) -> None:
    for text in ("old", "new"):
        with replacing(tmp_path / "folder") as partial:
            partial.mkdir()
            (partial / f"{text}.txt").write_text(text)
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]
    assert [p.name for p in (tmp_path / "folder").iterdir()] == ["new.txt"]

    def fail() -> None:
        with replacing(tmp_path / "folder") as partial:
            partial.mkdir()
            (partial / "half.txt").write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]


def test_a_product_is_current_until_a_setting_or_an_input_changes(tmp_path: Path) -> None:
    product = tmp_path / "mesh.ply"
    record = stage_record("recon", Knobs(), {"take": "abc"})
    assert not is_current(product, record)
    product.write_text("mesh")
    assert not is_current(product, record)
    write_record(product, record)
    assert is_current(product, stage_record("recon", Knobs(), {"take": "abc"}))
    assert not is_current(product, stage_record("recon", Knobs(2.0), {"take": "abc"}))
    assert not is_current(product, stage_record("recon", Knobs(), {"take": "abd"}))
    record_path(product).write_text("{")
    assert not is_current(product, record)
    write_record(product, record)
    product.unlink()
    assert not is_current(product, record)


def test_hashes_are_of_the_bytes(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    assert hash_file(tmp_path / "a").startswith("ba7816bf8f01cfea414140de5dae2223")


def test_a_product_whose_bytes_changed_is_made_again(tmp_path: Path) -> None:
    product = tmp_path / "scan.ply"
    record = stage_record("recon", Knobs(), {"take": "abc"})
    product.write_bytes(b"whole and sound")
    write_record(product, record)
    assert is_current(product, record)
    product.write_bytes(b"whole and s")
    assert not is_current(product, record)
    product.write_bytes(b"whole and sound")
    assert is_current(product, record)
    record_path(product).write_text("[" * 100_000)
    assert not is_current(product, record)


def test_a_product_of_these_inputs_is_known_whatever_its_settings(tmp_path: Path) -> None:
    product = tmp_path / "scan.ply"
    product.write_bytes(b"surface")
    write_record(product, stage_record("recon", None, {"take": "a1", "frame": "0"}))
    assert is_made_of(product, {"take": "a1"})
    assert not is_made_of(product, {"take": "b2"})
    product.write_bytes(b"surf")
    assert not is_made_of(product, {"take": "a1"})
