"""Packages whose public names are loaded when they are first used, so that a command line need not wait for them."""

import sys
from collections.abc import Mapping
from importlib import import_module
from types import ModuleType
from typing import Any


def load_on_use(package: str, homes: Mapping[str, str]) -> None:
    """Let a package offer names that live in its modules, without importing these.

    Parameters
    ----------
    package : str
        The package's ``__name__``; it calls this while it is imported.
    homes : mapping of str to str
        The names, and the package's module that each is found in. A name wins over a module of the same name:
        ``greenough.pipeline.decode`` is the function, whichever of the two was asked for first.
    """

    class Package(ModuleType):
        def __getattr__(self, name: str) -> Any:
            if name not in homes:
                raise AttributeError(f"module {package!r} has no attribute {name!r}")
            return getattr(import_module(f"{package}.{homes[name]}"), name)

        def __setattr__(self, name: str, value: object) -> None:
            # The import system binds every module that it has loaded to its package.
            if not (name in homes and isinstance(value, ModuleType)):
                super().__setattr__(name, value)

    sys.modules[package].__class__ = Package
