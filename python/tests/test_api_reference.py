"""Compares the public names and signatures of this package with those of the Python package stable-worldmodel, as of August
2026 (`api-2026-08.json`, a list of facts).

A program that is written against those names and signatures must find them here. Every exception is an entry of
`api-gaps.toml` with its reason; an entry that covers no difference fails, and so does a difference without an entry.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import json
from pathlib import Path
from typing import Any

import pytest

tomllib = pytest.importorskip("tomllib")
pytest.importorskip("torch")

HERE = Path(__file__).parent
EMPTY = inspect.Parameter.empty
POSITIONAL = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)


def reference() -> dict[str, dict[str, Any]]:
    """The public names by module; imports from other packages are left out."""
    modules = json.loads((HERE / "api-2026-08.json").read_text())
    return {module: {name: what for name, what in names.items() if _is_public(name, what)} for module, names in modules.items()}


def _is_public(name: str, what: Any) -> bool:
    third_party = (
        isinstance(what, str) and what.startswith("from ") and not what.startswith(("from .", "from stable_worldmodel"))
    )
    return name != "*" and not name.startswith("_") and not third_party


def parsed(signature: str) -> list[tuple[str, str, Any]]:
    """The parameters `(name, kind, default)` of a signature `def(...)`, without `self` and `cls`."""
    definition: Any = ast.parse(f"{signature.replace('def', 'def f', 1)}: ...").body[0]
    arguments = definition.args
    positional = [*arguments.posonlyargs, *arguments.args]
    defaults: list[Any] = [None] * (len(positional) - len(arguments.defaults)) + list(arguments.defaults)
    found = [(a.arg, "positional", d) for a, d in zip(positional, defaults, strict=True)]
    if arguments.vararg:
        found.append((arguments.vararg.arg, "args", None))
    found += [(a.arg, "keyword", d) for a, d in zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)]
    if arguments.kwarg:
        found.append((arguments.kwarg.arg, "kwargs", None))
    return [parameter for parameter in found if parameter[0] not in ("self", "cls")]


def differences(wanted: str, given: Any) -> list[str]:
    """What a call that fits the signature `wanted` would find different in the callable `given`."""
    parameters = [p for p in inspect.signature(given).parameters.values() if p.name not in ("self", "cls")]
    by_name = {p.name: p for p in parameters}
    takes_any = {p.kind for p in parameters}
    any_keyword = inspect.Parameter.VAR_KEYWORD in takes_any
    any_position = inspect.Parameter.VAR_POSITIONAL in takes_any
    order = [p.name for p in parameters if p.kind in POSITIONAL]
    found, names = [], []
    for position, (name, kind, default) in enumerate(parsed(wanted)):
        names.append(name)
        if kind in ("args", "kwargs"):
            continue
        ours = by_name.get(name)
        if ours is None or ours.kind in (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL):
            if not (any_keyword and (kind == "keyword" or any_position)):
                found.append(f"{name}: missing")
            continue
        if kind == "positional" and not any_position and (position >= len(order) or order[position] != name):
            found.append(f"{name}: not parameter {position + 1}")
        if default is not None:
            found += _different_default(name, default, ours.default)
    extra = [p.name for p in parameters if p.name not in names and p.default is EMPTY and p.kind in POSITIONAL]
    return found + [f"{name}: required here" for name in extra]


def _different_default(name: str, wanted: Any, ours: Any) -> list[str]:
    if ours is EMPTY:
        return [f"{name}: required here"]
    try:
        value = ast.literal_eval(wanted)
    except ValueError:
        return []  # An expression; its value is not among the facts.
    return [] if repr(value) == repr(ours) or value == ours else [f"{name}: default {ours!r}, there {value!r}"]


def compared() -> tuple[int, dict[str, str]]:
    """The number of names and members, and the differences by dotted path."""
    count, found = 0, {}
    for module, names in reference().items():
        try:
            package: Any = importlib.import_module(module)
        except ImportError:
            package = None
        for name, what in names.items():
            path = f"{module}.{name}"
            count += 1
            ours = getattr(package, name, None)
            if ours is None and not _holds_none(package, name):
                found[path] = "missing"
            elif isinstance(what, dict):
                if not isinstance(ours, type):
                    found[path] = f"a class there, here {type(ours).__name__}"
                    continue
                for member, signature in what["members"].items():
                    count += 1
                    problem = _member(ours, member, signature)
                    if problem:
                        found[f"{path}.{member}"] = problem
            elif what.startswith("def("):
                problem = "; ".join(differences(what, ours)) if callable(ours) else "not callable"
                if problem:
                    found[path] = problem
    return count, found


def _holds_none(package: Any, name: str) -> bool:
    return package is not None and hasattr(package, name)


def _member(cls: type, member: str, signature: str) -> str:
    ours = inspect.getattr_static(cls, member, None)
    if ours is None:
        # Attributes that instances set are declared in the class.
        declared = any(member in vars(base).get("__annotations__", {}) for base in cls.__mro__)
        return "" if declared and signature == "property" else "missing"
    if signature == "property":
        return ""
    given = getattr(cls, member)
    return "; ".join(differences(signature, given)) if callable(given) else "not callable"


def gaps() -> dict[str, str]:
    entries = tomllib.loads((HERE / "api-gaps.toml").read_text())["gap"]
    found = {name: entry["reason"] for entry in entries for name in entry["names"]}
    assert all(len(reason) > 10 for reason in found.values()), "every gap needs a reason"
    return found


def covers(gap: str, path: str) -> bool:
    return path == gap or path.startswith(f"{gap}.")


def test_names_and_signatures_are_those_of_the_reference_except_for_listed_gaps():
    count, found = compared()
    listed = gaps()
    new = {path: what for path, what in found.items() if not any(covers(gap, path) for gap in listed)}
    stale = [gap for gap in listed if not any(covers(gap, path) for path in found)]
    print(f"{count - len(found)} of {count} names and members resolve")
    assert not new, "differences without an entry in api-gaps.toml:\n" + "\n".join(f"{k}: {v}" for k, v in new.items())
    assert not stale, f"entries of api-gaps.toml without a difference: {stale}"


def test_the_comparison_finds_differences():
    def ours(self, a, b=1, *, c=2): ...

    assert differences("def(self, a, b=1)", ours) == []
    assert differences("def(self, a, b=1, c=2)", ours) == ["c: not parameter 3"]
    assert differences("def(self, a, b=2)", ours) == ["b: default 1, there 2"]
    assert differences("def(self, b=1)", ours) == ["b: not parameter 1", "a: required here"]
    assert differences("def(self, a, d)", ours) == ["d: missing"]
    assert differences("def(self, a, *, c=2)", ours) == []
    assert differences("def(x=0)", lambda *args, **kwargs: None) == []
    assert covers("a.b", "a.b.c") and covers("a.b", "a.b") and not covers("a.b", "a.bc")
