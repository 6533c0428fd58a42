"""The layers of docs/layout.md: imports run downwards only, and no imports form a circle."""

import ast
import re
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FACES = ("vggtjax", "vggtjax.__main__")  # the public names, and `python -m vggtjax`: above all layers
Graph = dict[str, set[str]]


def layers(text: str) -> dict[str, int]:
    """Return folder or file -> layer, as the table says."""
    rows = re.findall(r"^\| (\d+) \| (.*) \|$", text, flags=re.MULTILINE)
    return {name: int(layer) for layer, names in rows for name in re.findall(r"`(\w+)/?`", names)}


def imports(root: Path) -> Graph:
    """Return module -> modules that it imports anywhere, inside functions too; modules of this repository alone."""
    tops = ("vggtjax", "converters", "benchmarks")
    paths = {
        ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): path
        for top in tops
        for path in (root / top).rglob("*.py")
    }
    graph: Graph = {}
    for module, path in paths.items():
        graph[module] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                graph[module] |= {alias.name for alias in node.names if alias.name in paths}
            elif isinstance(node, ast.ImportFrom) and str(node.module).split(".")[0] in tops:
                for alias in node.names:
                    name = f"{node.module}.{alias.name}"
                    if alias.name != "__version__":
                        graph[module].add(name if name in paths else str(node.module))
        graph[module].discard(module)
    return graph


def room(module: str) -> str:
    """Return the folder or file that stands in the table."""
    first, *rest = module.split(".")
    return rest[0] if first == "vggtjax" and rest else first


def upward(graph: Graph, layer: dict[str, int]) -> list[str]:
    """Return the imports that run upwards; the face of the package is above all but benchmarks."""
    top = max(layer.values()) - 1
    rank = {module: layer.get(room(module), top) for module in set(graph).union(*graph.values())}
    return sorted(
        f"{module} -> {target}"
        for module, targets in graph.items()
        for target in targets
        if module not in FACES and (rank[module] < rank[target] or (target in FACES and rank[module] <= top))
    )


def circle(graph: Graph) -> list[str]:
    """Return the modules of a circle; empty where there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


@pytest.fixture(scope="module")
def layer() -> dict[str, int]:
    return layers((ROOT / "docs" / "layout.md").read_text())


@pytest.fixture(scope="module")
def graph() -> Graph:
    return imports(ROOT)


def test_imports_run_downwards(graph, layer):
    assert {room(module) for module in graph if module not in FACES} == set(layer)
    assert upward(graph, layer) == []


def test_imports_form_no_circle(graph):
    assert circle(graph) == []


def test_an_upward_import_and_a_circle_are_found(graph, layer):
    worse = graph | {"vggtjax.network.rope": {"vggtjax.method.mask"}}
    assert upward(worse, layer) == ["vggtjax.network.rope -> vggtjax.method.mask"]
    assert "vggtjax.errors" in circle(graph | {"vggtjax.errors": {"vggtjax.cameras"}})


def test_the_root_is_small():
    assert len(list((ROOT / "vggtjax").glob("*.py"))) <= 8


def test_the_page_names_every_file():
    rows = re.findall(r"^\| `([\w/]+)/` \| (.*) \|$", (ROOT / "docs" / "layout.md").read_text(), flags=re.MULTILINE)
    named = {folder: sorted(re.findall(r"`(\w+)`", files)) for folder, files in rows}
    files: dict[str, list[str]] = {}
    for path in sorted([*(ROOT / "vggtjax").rglob("*.py"), *(ROOT / "converters").rglob("*.py")]):
        if not path.stem.startswith("__"):
            files.setdefault(str(path.parent.relative_to(ROOT)), []).append(path.stem)
    assert named == files
