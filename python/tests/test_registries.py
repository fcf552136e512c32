"""Tests that the Python classes match the registries of the engine: ids, settings and defaults."""

import json

import pytest

import stable_worldmodel as swm
from stable_worldmodel import _engine, solver
from stable_worldmodel.data import formats
from stable_worldmodel.wrapper import visual

SOLVERS = {kind.id: kind for name in solver.__all__ if hasattr(kind := getattr(solver, name), "id")}
WRAPPERS = {kind.id: kind for name in visual.__all__ if hasattr(kind := getattr(visual, name), "id")}


def test_every_engine_solver_has_a_python_class():
    assert set(SOLVERS) == set(json.loads(_engine.solvers()))


@pytest.mark.parametrize("id", SOLVERS)
def test_python_classes_accept_the_settings_of_engine_solvers(id):
    kind, defaults = SOLVERS[id], json.loads(_engine.solvers())[id]
    assert set(kind._names.values()) <= set(defaults)
    # The engine's defaults are valid settings of the class.
    assert kind("simulator", **defaults).settings == defaults


def test_every_engine_wrapper_has_a_python_class():
    assert set(WRAPPERS) == set(json.loads(_engine.wrappers()))


@pytest.mark.parametrize("id", WRAPPERS)
def test_positional_settings_of_wrappers_exist_in_the_engine(id):
    parameters = json.loads(_engine.wrappers())[id]["parameters"]
    assert set(WRAPPERS[id].positional) <= set(parameters)


def test_every_engine_format_is_registered():
    native = {name for name, kind in swm.data.FORMATS.items() if kind.native}
    assert native == set(_engine.formats())
    assert set(formats._READERS) <= native
    writers = (formats.LanceWriter, formats.HDF5Writer, formats.VideoWriter, formats.FolderWriter)
    assert {kind.format for kind in writers} <= native


@pytest.mark.parametrize("env", swm.envs.ids())
def test_experts_equal_the_engine_experts(env):
    try:
        described = swm.utils.describe(env)
    except ValueError as error:
        if "swm assets" not in str(error):
            raise
        pytest.skip("needs `swm assets`")
    assert swm.envs.experts(env) == [expert["id"] for expert in described["experts"]]
