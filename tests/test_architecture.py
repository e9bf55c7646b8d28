"""The house rules as tests: sizes, names, floors, vendors, quiet imports."""

from __future__ import annotations

import ast
import functools
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FLOORS = ("capture", "recon", "track", "rig", "tools")
FORBIDDEN = {"utils", "util", "common", "helpers", "misc", "core", "base", "types"}
DATA_TABLES: set[str] = set()  # files that hold only a table of numbers, excepted by name
VENDORS = {
    "pycolmap": r"recon/colmap\.py|tools/bench/fusion_opponents\.py",
    "open3d": r"recon/surface\.py|tools/bench/fusion_opponents\.py",
    "moderngl": r"(track/(raster|gpu)\w*\.py|tools/actor/\w+\.py)",
    "pxr": r"rig/export_usd\.py",
    "pygltflib": r"rig/export_gltf\.py",
    "tyro": r"tools/(cli|__main__)\.py|tools/verbs/\w+\.py|tools/actor/\w+\.py|tools/\w+\.py",
    "dlib": r"track/landmark_dlib\.py",
    "dask": r"tools/engine/\w+\.py",
    "gi": r"capture/devices/aravis/\w+\.py",
    "textual": r"tools/terminal/\w+\.py",
    "rich": r"tools/terminal/\w+\.py",
    "cv2": r"(recon|track|tools)/.*",
    "scipy": r"(recon|track|rig|tools)/.*",
    "numba": r"(recon|track|rig)/.*",
}


def sources() -> list[Path]:
    return [path for floor in FLOORS for path in sorted((ROOT / floor).rglob("*.py"))]


@functools.cache
def trees() -> tuple[tuple[str, ast.Module], ...]:
    return tuple(
        (str(path.relative_to(ROOT)), ast.parse(path.read_text(encoding="utf-8")))
        for path in sources()
    )


def imported(tree: ast.Module) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return names


def functions(tree: ast.Module) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    return [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]


def test_files_are_at_most_500_lines() -> None:
    tall = {
        str(path.relative_to(ROOT)): lines
        for path in [*sources(), *sorted((ROOT / "tests").rglob("*.py"))]
        if (lines := len(path.read_text(encoding="utf-8").splitlines())) > 500
        and str(path.relative_to(ROOT)) not in DATA_TABLES
    }
    assert not tall


def test_functions_are_at_most_80_lines() -> None:
    long = {
        f"{name}:{node.name}": size
        for name, tree in trees()
        for node in functions(tree)
        if (size := (node.end_lineno or 0) - node.lineno + 1) > 80
    }
    assert not long


def test_functions_take_at_most_7_parameters() -> None:
    wide = {}
    for name, tree in trees():
        for node in functions(tree):
            numbered = any("njit" in ast.unparse(d) for d in node.decorator_list)
            a = node.args
            names = [p.arg for p in a.posonlyargs + a.args + a.kwonlyargs]
            count = len([p for p in names if p not in ("self", "cls", "progress")])
            # A numba kernel cannot take a dataclass; its Python door can and must.
            if count > 7 and not (numbered and node.name.startswith("_")):
                wide[f"{name}:{node.name}"] = count
    assert not wide


def test_modules_have_at_most_12_public_names() -> None:
    crowded = {}
    for name, tree in trees():
        public = [
            node.name
            for node in tree.body
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_")
        ]
        if len(public) > 12:
            crowded[name] = public
    assert not crowded


def test_no_module_is_a_drawer() -> None:
    assert not [p for p in sources() if p.stem in FORBIDDEN or p.parent.name in FORBIDDEN]


def test_imports_point_down() -> None:
    wrong = []
    for name, tree in trees():
        floor = FLOORS.index(name.split("/")[0])
        for module in imported(tree):
            top = module.split(".")[0]
            if top == "tests" or (top in FLOORS and FLOORS.index(top) > floor):
                wrong.append(f"{name} imports {module}")
    assert not wrong


@pytest.mark.parametrize("vendor", sorted(VENDORS))
def test_each_vendor_has_one_home(vendor: str) -> None:
    strays = [
        name
        for name, tree in trees()
        if any(module.split(".")[0] == vendor for module in imported(tree))
        and not re.fullmatch(VENDORS[vendor], name)
    ]
    assert not strays


def test_capture_imports_with_numpy_alone() -> None:
    modules = [
        str(p.relative_to(ROOT).with_suffix("")).replace("/", ".").removesuffix(".__init__")
        for p in sorted((ROOT / "capture").rglob("*.py"))
    ]
    code = (
        "import importlib, sys\n"
        f"[importlib.import_module(m) for m in {modules!r}]\n"
        "loud = {'cv2','scipy','numba','open3d','pycolmap','moderngl','tyro'} & set(sys.modules)\n"
        "sys.exit(f'capture imports {sorted(loud)}' if loud else 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""


def test_imports_are_quiet() -> None:
    code = "import recon.scan, track.stage, rig.stage, rig.export, tools.cli, tools.report"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_no_assert_and_no_blind_except_outside_tests() -> None:
    found = []
    for name, tree in trees():
        for node in ast.walk(tree):
            if isinstance(node, ast.Assert):
                found.append(f"{name}:{node.lineno} assert")
            if isinstance(node, ast.ExceptHandler):
                kind = ast.unparse(node.type) if node.type else ""
                # Some vendors raise a bare Exception: it may be translated, never swallowed.
                raises = any(isinstance(n, ast.Raise) for n in node.body)
                if kind in ("", "Exception", "BaseException") and not raises:
                    found.append(f"{name}:{node.lineno} except {kind}")
    assert not found


def test_no_public_name_says_extrinsics_or_c2w() -> None:
    bad = re.compile(r"(extrinsic|c2w|w2c|cam2world|world2cam)", re.IGNORECASE)
    found = [
        f"{name}:{node.name}"
        for name, tree in trees()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.ClassDef)
        and not node.name.startswith("_")
        and bad.search(node.name)
    ]
    assert not found


def test_nothing_unpickles() -> None:
    strays = []
    for name, tree in trees():
        if {"pickle", "dill", "joblib", "shelve"} & {m.split(".")[0] for m in imported(tree)}:
            strays.append(name)
        for node in ast.walk(tree):
            if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
                safe = isinstance(node.value, ast.Constant) and node.value.value is False
                strays += [] if safe else [f"{name}:{node.value.lineno}"]
    assert not strays


def test_no_path_of_a_machine_and_no_registry_host() -> None:
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split("\n")
    bad = re.compile(r"/(home|work|root)/[a-z]|pypi\.org|pythonhosted|registry\.npmjs")
    found = [
        name
        for name in listed
        if name
        and name != "tests/test_architecture.py"
        and (ROOT / name).suffix in (".py", ".md", ".toml", ".lock", ".sh", "")
        and (ROOT / name).is_file()
        and bad.search((ROOT / name).read_text(encoding="utf-8", errors="replace"))
    ]
    assert not found
