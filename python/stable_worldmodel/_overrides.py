"""Which methods of the package's classes a user replaces, so that the engine must not stand in for them."""

from __future__ import annotations

import inspect
from typing import Any

#: Libraries whose decorators the package uses: their wrappers belong to what they wrap.
_DECORATORS = ("torch", "functools", "contextlib")


def is_overridden(given: Any, method: str) -> bool:
    """Whether `method` of an object or a class is a user's: of a subclass, set on the object or the class, or of an object that
    passes calls on to another one."""
    kind = given if isinstance(given, type) else type(given)
    if kind is not given and method in getattr(given, "__dict__", {}):
        return True
    owner = next((base for base in kind.__mro__ if method in vars(base)), None)
    if owner is None or not _is_own(owner.__module__):
        return True
    function = inspect.getattr_static(kind, method)
    function = getattr(function, "__func__", getattr(function, "fget", function))
    # `functools.wraps` copies `__module__`, but not the globals.
    module = _module(function)
    while module.split(".")[0] in _DECORATORS and hasattr(function, "__wrapped__"):
        function = function.__wrapped__
        module = _module(function)
    return not _is_own(module)


def engine_part(given: Any, attribute: str, *methods: str) -> Any:
    """The part of the engine that a model of the package stands for; `None` where it stands for none.

    Models that replace one of `methods` stand for none, nor do objects that pass unknown attributes on to a model.
    """
    if inspect.getattr_static(given, attribute, None) is None or any(is_overridden(given, method) for method in methods):
        return None
    return getattr(given, attribute)


def _module(function: Any) -> str:
    named = getattr(function, "__globals__", {}).get("__name__")
    return str(
        named or getattr(function, "__module__", None) or getattr(getattr(function, "__objclass__", None), "__module__", "")
    )


def _is_own(module: str) -> bool:
    return module.split(".")[0] == "stable_worldmodel"
