"""The rules of CONTRIBUTING.md that a program can check, checked on the sources.

`lint-imports` (in `make lint`) checks which folder may import which.
"""

import ast
import importlib
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("sim", "replay", "actors", "learner", "launch")
SOURCES = sorted(path for name in PACKAGES for path in (ROOT / name).rglob("*.py"))
TESTS = sorted((ROOT / "tests").rglob("*.py"))
KEY_MAKERS = re.compile(r"\b(PRNGKey|random\.key)\(")


def relative(path: Path) -> str:
    """The path as messages print it."""
    return path.relative_to(ROOT).as_posix()


def nodes(path: Path) -> Iterator[ast.AST]:
    """Every node of a file's syntax tree."""
    return ast.walk(ast.parse(path.read_text()))


def names_of(node: ast.expr) -> str:
    """A decorator or base as dotted text, without call arguments or subscripts."""
    if isinstance(node, ast.Call):
        node = node.func
    if isinstance(node, ast.Subscript):
        node = node.value
    return ast.unparse(node)


@pytest.mark.parametrize("name", PACKAGES)
def test_package_is_ours(name: str) -> None:
    """Other software (ROS 2) has a package `launch` too."""
    module = importlib.import_module(name)
    assert Path(str(module.__file__)).is_relative_to(ROOT)


def config_fields() -> dict[str, str]:
    """Every field of every dataclass called ...Config, and where it stands."""
    found = {}
    for path in SOURCES:
        for node in nodes(path):
            if isinstance(node, ast.ClassDef) and node.name.endswith("Config"):
                for item in node.body:
                    if isinstance(item, ast.AnnAssign) and isinstance(
                        item.target, ast.Name
                    ):
                        found[item.target.id] = f"{relative(path)}:{item.lineno}"
    return found


def test_every_config_field_is_read() -> None:
    """A knob nothing reads is a lie to the user."""
    reads = {
        node.attr
        for path in SOURCES
        for node in nodes(path)
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load)
    }
    unread = {name: at for name, at in config_fields().items() if name not in reads}
    assert not unread


def test_every_config_field_is_documented() -> None:
    """The docstring below a field is its help text on the command line."""
    missing = []
    for path in SOURCES:
        for node in nodes(path):
            if not (isinstance(node, ast.ClassDef) and node.name.endswith("Config")):
                continue
            followers = [*node.body[1:], None]
            for item, after in zip(node.body, followers, strict=True):
                documented = isinstance(after, ast.Expr) and isinstance(
                    after.value, ast.Constant
                )
                if isinstance(item, ast.AnnAssign) and not documented:
                    missing.append(f"{relative(path)}:{item.lineno}")
    assert not missing


def test_network_keys_are_spelled_in_one_module() -> None:
    found = [
        f"{relative(path)}:{node.lineno}"
        for path in SOURCES
        if relative(path) != "replay/keys.py"
        for node in nodes(path)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and node.value.startswith("slipstream/")
    ]
    assert not found


def test_random_keys_are_made_in_launch_and_tests_only() -> None:
    found = [
        relative(path)
        for path in SOURCES
        if not relative(path).startswith("launch/")
        and KEY_MAKERS.search(path.read_text())
    ]
    assert not found


DATA_BASES = {"NamedTuple", "msgspec.Struct", "Struct"}
OPEN_BASES = {"abc.ABC", "ABC", "Protocol", "Exception"}


def is_abstract_final_or_data(node: ast.ClassDef, errors: set[str]) -> bool:
    """Abstract, `@final`, or a record, an enumeration, an exception."""
    bases = {names_of(base) for base in node.bases}
    decorators = {names_of(decorator) for decorator in node.decorator_list}
    return bool(
        bases & (DATA_BASES | OPEN_BASES | errors)
        or any(re.search(r"(Enum|Flag|Error)$", base) for base in bases)
        or decorators & {"final", "typing.final", "dataclass", "dataclasses.dataclass"}
    )


def test_a_class_is_abstract_or_final() -> None:
    classes = [
        (path, node)
        for path in SOURCES
        for node in nodes(path)
        if isinstance(node, ast.ClassDef)
    ]
    errors = {node.name for _, node in classes if node.name.endswith("Error")}
    found = [
        f"{relative(path)}:{node.lineno} {node.name}"
        for path, node in classes
        if not is_abstract_final_or_data(node, errors)
    ]
    assert not found


def test_state_and_settings_are_frozen() -> None:
    """Records everywhere but in a service's own counters."""
    found = []
    for path in SOURCES:
        for node in nodes(path):
            if not isinstance(node, ast.ClassDef):
                continue
            pure = relative(path).startswith(("sim/", "actors/", "learner/"))
            if pure or node.name.endswith("Config"):
                found += [
                    f"{relative(path)}:{node.lineno} {node.name}"
                    for decorator in node.decorator_list
                    if "dataclass" in (text := ast.unparse(decorator))
                    and "frozen=True" not in text
                ]
    assert not found


def words(path: Path) -> set[str]:
    """The identifiers of a file."""
    tokens = tokenize.generate_tokens(io.StringIO(path.read_text()).readline)
    return {token.string for token in tokens if token.type == tokenize.NAME}


def test_time_limits_and_ends_are_told_apart() -> None:
    """`done` says neither which; `discount_t` and `truncated` do."""
    found = [
        relative(path) for path in SOURCES if words(path) & {"done", "dones", "is_done"}
    ]
    assert not found


def test_no_super_and_no_hasattr() -> None:
    """Classes are abstract or final, so neither has a use (`torch` demands one)."""
    found = [
        relative(path)
        for path in SOURCES
        if "hasattr" in words(path)
        or re.search(r"super\(\)\.(?!__init__\(\)$)", path.read_text(), re.MULTILINE)
    ]
    assert not found


def test_files_are_small() -> None:
    found = {
        relative(path): lines
        for path in SOURCES
        if (lines := len(path.read_text().splitlines())) > 400
    }
    assert not found


def test_nothing_is_pickled_or_evaluated() -> None:
    """What arrives from a network or a file is data, never code."""
    found = [
        f"{relative(path)}:{node.lineno}"
        for path in SOURCES
        for node in nodes(path)
        if (isinstance(node, ast.Call) and ast.unparse(node.func) in {"eval", "exec"})
        or {"pickle", "cloudpickle"} & set(imported(node))
    ]
    assert not found


def test_no_address_stands_in_what_is_installed() -> None:
    """Pins hold no index, so the user's own is used."""
    for name in ("constraints.txt", "pyproject.toml", ".pre-commit-config.yaml"):
        assert "://" not in (ROOT / name).read_text(), name


def test_every_import_is_a_declared_dependency() -> None:
    """An extra that lacks a package fails on a machine of one role only."""
    declared = (ROOT / "pyproject.toml").read_text().replace("-", "_")
    known = {"zenoh": "eclipse_zenoh", "rerun": "rerun_sdk", "google": "protobuf"}
    known |= {"rerun_cli": "rerun_sdk"}
    # tensordict comes with torchrl and jaxlib with jax, at matching versions.
    known |= {"tensordict": "torchrl", "jaxlib": "jax"}
    outside = {
        (relative(path), name.split(".")[0])
        for path in SOURCES
        for node in nodes(path)
        for name in imported(node)
    }
    missing = {
        (path, name)
        for path, name in outside
        if name not in PACKAGES
        and name not in sys.stdlib_module_names
        and known.get(name, name) not in declared
    }
    assert not missing


def imported(node: ast.AST) -> list[str]:
    """The modules that an import statement names."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
        return [node.module]
    return []
