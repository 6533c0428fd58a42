"""The subpackages of docs/layout.md: imports run downwards only, and no imports form a circle."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from importlib.util import resolve_name
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TOPS = ("vggtjax", "converters", "benchmarks")
FACES = ("vggtjax", "vggtjax.__main__")  # the public names, and `python -m vggtjax`: above all layers
Graph = dict[str, set[str]]


def layers(text: str) -> dict[str, int]:
    """Return subpackage or module -> its number, as the table says."""
    rows = re.findall(r"^\| (\d+) \| (.*) \|$", text, flags=re.MULTILINE)
    return {name: int(layer) for layer, names in rows for name in re.findall(r"`(\w+)/?`", names)}


def imports(root: Path) -> Graph:
    """Return module -> modules that it imports anywhere: in functions, in stubs, relatively, or by a name in a string.

    Only modules of this repository count.
    """
    files = [path for top in TOPS for path in sorted((root / top).rglob("*.py*")) if path.suffix in (".py", ".pyi")]
    modules = {".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__") for path in files}
    graph: Graph = {module: set() for module in modules}
    for path in files:
        package = ".".join(path.relative_to(root).parent.parts)
        module = package if path.stem == "__init__" else f"{package}.{path.stem}"
        for node in ast.walk(ast.parse(path.read_text())):
            graph[module] |= set(imported(node, package, modules))
        graph[module].discard(module)
    return graph


def imported(node: ast.AST, package: str, modules: set[str]) -> Iterator[str]:
    """Yield the modules that a node of a file in `package` imports; a string that names a module counts."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names if alias.name in modules)
    elif isinstance(node, ast.ImportFrom):
        source = resolve_name("." * node.level + (node.module or ""), package)
        if source.split(".")[0] in TOPS:
            names = [alias.name for alias in node.names if alias.name != "__version__"]
            yield from (f"{source}.{name}" if f"{source}.{name}" in modules else source for name in names)
    elif isinstance(node, ast.Constant) and isinstance(node.value, str) and re.fullmatch(r"\.*\w+(\.\w+)+", node.value):
        depth = len(node.value) - len(node.value.lstrip("."))
        if depth <= package.count(".") + 1 and (name := resolve_name(node.value, package)) in modules:
            yield name


def room(module: str) -> str:
    """Return the folder or file that stands in the table."""
    first, *rest = module.split(".")
    return rest[0] if first == "vggtjax" and rest else first


def upward(graph: Graph, layer: dict[str, int]) -> list[str]:
    """Return the imports that run upwards, or between subpackages of one number; the face of the package is on top."""
    top = max(layer.values()) - 1
    rank = {module: layer.get(room(module), top) for module in set(graph).union(*graph.values())}
    return sorted(
        f"{module} -> {target}"
        for module, targets in graph.items()
        for target in targets
        if module not in FACES
        and (
            (rank[module] <= rank[target] and room(module) != room(target)) or (target in FACES and rank[module] <= top)
        )
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


def folders(graph: Graph) -> Graph:
    """Return folder or file of the root -> those that it imports from; the public names belong to none."""
    arrows: Graph = {room(module): set() for module in graph if module not in FACES}
    for module in graph.keys() - set(FACES):
        arrows[room(module)] |= {room(target) for target in graph[module] - set(FACES)} - {room(module)}
    return arrows


def test_imports_of_subpackages_form_no_circle(graph):
    assert circle(folders(graph)) == []
    twice = {"vggtjax.method.mask": {"vggtjax.results.frame"}, "vggtjax.results.result": {"vggtjax.method.mask"}}
    assert set(circle(folders(graph | twice))) == {"results", "method"}


def test_the_network_loads_no_library_of_the_command_line():
    code = "import sys, vggtjax.network.model; print({'tyro', 'gradio'} & set(sys.modules))"
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "set()\n"


def test_nothing_above_the_network_asks_for_its_family():
    allowed = {"config.py", "network", "pipeline/pretrained"}
    paths = [path for path in (ROOT / "vggtjax").rglob("*.py") if path.parent != ROOT / "vggtjax/network"]
    asks = re.compile(r"model\.config\.family|config\.family [!=]=|vggtjax\.config import .*\b(FAMILIES|DA3)\b")
    found = {str(path.relative_to(ROOT / "vggtjax")) for path in paths if asks.search(path.read_text(encoding="utf-8"))}
    assert {name for name in found if not any(name.startswith(start) for start in allowed)} == set()


def test_an_upward_import_and_a_circle_are_found(graph, layer):
    worse = graph | {"vggtjax.network.positions": {"vggtjax.method.mask"}}
    assert upward(worse, layer) == ["vggtjax.network.positions -> vggtjax.method.mask"]
    assert "vggtjax.errors" in circle(graph | {"vggtjax.errors": {"vggtjax.cameras"}})


@pytest.mark.parametrize(
    ("folder", "other"),
    [("tests", r"benchmarks\b"), ("benchmarks", r"tests\b(?!\.shared)"), ("tests/shared", r"tests\b(?!\.shared)")],
)
def test_tests_and_benchmarks_share_one_folder(folder, other):
    """But for tests/benchmarks, which tests the benchmarks' own code."""
    files = [path for path in (ROOT / folder).rglob("*.py") if path.parent != ROOT / "tests/benchmarks"]
    importing = re.compile(rf"^\W*(from|import) {other}", flags=re.MULTILINE)
    assert [str(path) for path in files if importing.search(path.read_text())] == []


def test_the_house_is_small():
    package = ROOT / "vggtjax"
    assert len(list(package.glob("*.py"))) <= 8
    assert len({path.relative_to(package).parts[0] for path in package.glob("*/**/*.py")}) == 9  # folders of code
    assert len(list((package / "network").glob("*.py"))) <= 12
    assert len(list((package / "method").glob("*.py"))) <= 10
