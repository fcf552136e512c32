"""Tests of the engine's solvers with models implemented in Python."""

import json
import os
import pathlib
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

import stable_worldmodel as swm

torch = pytest.importorskip("torch")
torch.set_num_threads(1)

from stable_worldmodel import _engine  # noqa: E402
from stable_worldmodel import solver as solvers  # noqa: E402
from stable_worldmodel.planning.solver.callbacks import Callback  # noqa: E402
from stable_worldmodel.world.env_pool import EnvPool  # noqa: E402

BOX = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
CHOICES = gymnasium.spaces.Discrete(3)
#: The cheapest action of each environment.
TARGETS = np.array([[0.5, -0.3], [-0.6, 0.2], [0.1, 0.8]], np.float32)


class Quadratic(torch.nn.Module):
    """A model whose cost is the squared distance of every action to `infos["target"]`."""

    def get_cost(self, info_dict, action_candidates):
        target = info_dict["target"][:, :, -1, None].to(action_candidates)
        return ((action_candidates - target.repeat(1, 1, 1, action_candidates.shape[-1] // 2)) ** 2).sum((2, 3))


class Constrained(Quadratic):
    """A `Quadratic` that constrains the first element of an action to at most 0.2."""

    def get_constraints(self, info_dict, action_candidates):
        return action_candidates[..., 0] - 0.2


class Prices(torch.nn.Module):
    """A model in which every choice costs 1, except the environment's `choice`, which costs 0."""

    def get_cost(self, info_dict, action_candidates):
        free = info_dict["choice"][:, :, -1, None, 0]
        at = torch.arange(action_candidates.shape[-1], device=action_candidates.device)
        return (action_candidates * (at != free[..., None])).sum((2, 3))


class Linear(torch.nn.Module):
    """A `Dynamics` that adds the action to the latent."""

    latent_dim = 2

    def encode(self, info_dict):
        return info_dict["state"][:, -1]

    def encode_goal(self, info_dict):
        return info_dict["target"][:, -1]

    def predict(self, latents, actions):
        return latents + actions


class NumpyQuadratic:
    backend = "numpy"

    def get_cost(self, info_dict, action_candidates):
        assert isinstance(action_candidates, np.ndarray) and isinstance(info_dict["target"], np.ndarray | torch.Tensor)
        return ((action_candidates - np.asarray(info_dict["target"])[:, :, -1, None]) ** 2).sum((2, 3))


def infos(rows=slice(None)):
    return {
        "target": TARGETS[rows, None],
        "state": np.zeros((3, 1, 2), np.float32)[rows],
        "choice": np.arange(3)[rows, None, None],
    }


def configured(solver, space=BOX, horizon=3, envs=3, **more):
    config = swm.PlanConfig(horizon=horizon, receding_horizon=horizon, **more)
    solver.configure(action_space=space, n_envs=envs, config=config)
    return solver


def plan(solver, rows=slice(None), space=BOX, **more):
    return configured(solver, space, **more).solve(infos(rows))["actions"].numpy()


SGD = {"optimizer_cls": torch.optim.SGD, "optimizer_kwargs": {"lr": 0.2}}
CONTINUOUS = [
    (solvers.PredictiveSamplingSolver, {"num_samples": 4000, "noise_scale": 0.7}, 0.35),
    (solvers.CEMSolver, {"num_samples": 200, "n_steps": 15, "topk": 20}, 0.02),
    (solvers.ICEMSolver, {"num_samples": 200, "n_steps": 15, "topk": 20}, 0.05),
    (solvers.MPPISolver, {"num_samples": 200, "n_steps": 20, "topk": 20, "temperature": 0.1, "var_scale": 0.3}, 0.1),
    (solvers.GradientSolver, {"num_samples": 4, "n_steps": 80}, 0.01),
    (solvers.GradientSolver, {"num_samples": 2, "n_steps": 30, **SGD}, 0.01),
]
CONTINUOUS_IDS = ["predictive-sampling", "cem", "icem", "mppi", "adam", "sgd"]
DISCRETE = [
    (solvers.CategoricalCEMSolver, {"num_samples": 60, "n_steps": 6, "topk": 10}),
    (solvers.PGDSolver, {"num_samples": 8, "n_steps": 20}),
]


@pytest.mark.parametrize(("solver", "settings", "tolerance"), CONTINUOUS, ids=CONTINUOUS_IDS)
def test_continuous_solvers_find_the_optimum(solver, settings, tolerance):
    found = configured(solver(Quadratic(), seed=3, **settings)).solve(infos())
    actions = found["actions"].numpy()
    assert actions.shape == (3, 3, 2) and actions.dtype == np.float32 and len(found["trace"]) == 3
    assert np.abs(actions - TARGETS[:, None]).max() < tolerance
    # The costs belong to the cheapest candidates; the plan may be the mean of several candidates.
    assert np.allclose(found["costs"], ((actions - TARGETS[:, None]) ** 2).sum((1, 2)), atol=0.02)


@pytest.mark.parametrize(("solver", "settings"), DISCRETE, ids=["categorical-cem", "pgd"])
def test_discrete_solvers_find_the_best_choices(solver, settings):
    actions = plan(solver(Prices(), **settings), space=CHOICES)
    assert actions.shape == (3, 3, 1) and actions.dtype == np.int64
    assert (actions == np.arange(3)[:, None, None]).all()
    # Two choices in one step of the model.
    blocks = plan(solver(BlockPrices(), **settings), space=CHOICES, action_block=2)
    assert blocks.shape == (3, 3, 2) and (blocks == np.arange(3)[:, None, None]).all()


class BlockPrices(Prices):
    def get_cost(self, info_dict, action_candidates):
        each = action_candidates.unflatten(-1, (2, 3)).movedim(3, 0)
        return sum(super(BlockPrices, self).get_cost(info_dict, part) for part in each)


def test_plans_satisfy_constraints():
    actions = plan(solvers.LagrangianSolver(Constrained(), num_samples=4, n_steps=60, n_outer_steps=8))
    allowed = np.minimum(TARGETS, [0.2, 1.0])
    assert np.abs(actions - allowed[:, None]).max() < 0.02
    assert actions[..., 0].max() < 0.2 + 0.01


def test_grasp_reaches_the_goal():
    # The search ends with a synchronisation, which fits the actions to a whole rollout.
    actions = plan(solvers.GRASPSolver(Linear(), n_steps=100, sync_every=50, sync_iterations=40))
    assert np.abs(actions.sum(1) - TARGETS).max() < 0.05
    with pytest.raises(AttributeError, match="latent_dim"):

        class WithoutLatentDim(Linear):
            latent_dim = None

        plan(solvers.GRASPSolver(WithoutLatentDim()))


def test_dynamics_are_rolled_out_by_an_evaluator():
    objectives = [swm.planning.GoalDistance(), swm.planning.ActionPenalty(1e-3)]
    evaluator = swm.planning.LatentCost(Linear(), objectives)
    settings = {"num_samples": 200, "n_steps": 15, "topk": 20}
    for model in (evaluator, Linear()):
        assert isinstance(Linear(), swm.planning.LatentDynamics)
        actions = plan(solvers.CEMSolver(model, **settings))
        assert np.abs(actions.sum(1) - TARGETS).max() < 0.05
    # The gradient passes through the rollout.
    actions = plan(solvers.GradientSolver(evaluator, num_samples=2, n_steps=60))
    assert np.abs(actions.sum(1) - TARGETS).max() < 0.05
    running = swm.planning.GoalDistance(2.0, running=True)
    trajectory = np.array([[[0.0], [1.0], [3.0]]])
    assert running(trajectory, np.array([[1.0]]), None).tolist() == [8.0]
    assert swm.planning.GoalDistance()(trajectory, np.array([[1.0]]), None).tolist() == [4.0]
    with pytest.raises(TypeError, match="encode"):
        swm.planning.LatentCost(Quadratic())


ALL = [
    *((solver, Quadratic(), BOX) for solver, _, _ in CONTINUOUS),
    (solvers.LagrangianSolver, Constrained(), BOX),
    *((solver, Prices(), CHOICES) for solver, _ in DISCRETE),
    (solvers.GRASPSolver, Linear(), BOX),
]
FEW = {"num_samples": 20, "n_steps": 3, "topk": 5}


def few(solver, model, **more):
    """A solver with a short search: with all settings of `FEW` that the solver supports."""
    known = json.loads(_engine.solvers())[solver.id]
    settings = {name: value for name, value in FEW.items() if solver._names.get(name, name) in known}
    return solver(model, **settings, **more)


@pytest.mark.parametrize(
    ("solver", "model", "space"), ALL, ids=[*CONTINUOUS_IDS, "lagrangian", "categorical-cem", "pgd", "grasp"]
)
def test_plan_depends_only_on_the_seed_and_the_infos_of_its_environment(solver, model, space):
    together = plan(few(solver, model, seed=8), space=space)
    for size in (1, 2):
        assert np.array_equal(plan(few(solver, model, seed=8, batch_size=size), space=space), together)
    # Environments planned alone and together get the same plans.
    assert np.array_equal(plan(few(solver, model, seed=8), slice(0, 1), space=space), together[:1])
    assert np.array_equal(plan(few(solver, model, seed=8), slice(0, 2), space=space), together[:2])
    # Every call uses new random numbers; the same sequence of calls returns the same plans.
    one, other = (configured(few(solver, model, seed=8), space) for _ in range(2))
    calls = [[solver.solve(infos())["actions"] for _ in range(2)] for solver in (one, other)]
    assert all(torch.equal(*pair) for pair in zip(*calls, strict=True))
    assert np.array_equal(calls[0][0], together)


def test_numpy_model_gets_numpy_candidates():
    actions = plan(solvers.CEMSolver(NumpyQuadratic(), num_samples=200, n_steps=15, topk=20))
    assert np.abs(actions - TARGETS[:, None]).max() < 0.02
    with pytest.raises(ValueError, match="gradient"):
        plan(solvers.GradientSolver(NumpyQuadratic()))


def test_search_starts_from_the_initial_actions():
    solver = configured(solvers.CEMSolver(Quadratic(), num_samples=30, n_steps=1, topk=3, var_scale=1e-4))
    init = np.full((3, 3, 2), 0.25, np.float32)
    assert np.allclose(solver.solve(infos(), init_action=init)["actions"], 0.25, atol=1e-2)
    # Shorter initial actions are padded with zeros.
    short = solver.solve(infos(), init_action=torch.from_numpy(init[:, :1]))["actions"]
    assert np.allclose(short[:, 0], 0.25, atol=1e-2) and np.allclose(short[:, 1:], 0, atol=1e-2)
    with pytest.raises(ValueError, match="init_action"):
        solver.solve(infos(), init_action=np.zeros((3, 4, 2)))


def test_model_runs_in_inference_mode_except_for_gradients():
    seen = []

    class Recording(Quadratic):
        def get_cost(self, info_dict, action_candidates):
            seen.append((torch.is_inference_mode_enabled(), self.training, action_candidates.requires_grad))
            return super().get_cost(info_dict, action_candidates)

    plan(few(solvers.CEMSolver, Recording()))
    assert set(seen) == {(True, False, False)}
    seen.clear()
    plan(few(solvers.GradientSolver, Recording()))
    assert (False, False, True) in seen


@pytest.mark.parametrize("solver", [solvers.CEMSolver, solvers.GradientSolver])
def test_planning_restores_the_mode_of_a_model(solver):
    class Recording(Quadratic):
        def get_cost(self, info_dict, action_candidates):
            seen.append((self.training, self.frozen.training))
            return super().get_cost(info_dict, action_candidates)

    seen = []
    model = Recording().train()
    model.frozen = torch.nn.Identity().eval()
    made = configured(few(solver, model))
    for _ in range(2):
        made.solve(infos())
        assert model.training and not model.frozen.training and set(seen) == {(False, False)}
    model.eval()
    made.solve(infos())
    assert not model.training


def test_infos_cached_by_a_model_last_for_one_search():
    computed = []

    class Caching(Quadratic):
        def get_cost(self, info_dict, action_candidates):
            if "encoded" not in info_dict:
                computed.append(len(action_candidates))
                info_dict["encoded"] = info_dict["target"] * 1.0
            return super().get_cost({"target": info_dict["encoded"]}, action_candidates)

    solver = configured(few(solvers.CEMSolver, Caching()))
    solver.solve(infos())
    assert computed == [3]
    solver.solve(infos())
    assert computed == [3, 3]


# Tests of errors.


class MyError(Exception):
    pass


class Wrong(Quadratic):
    def __init__(self, defect):
        super().__init__()
        self.defect = defect

    def get_cost(self, info_dict, action_candidates):
        cost = (action_candidates**2).sum((2, 3))
        if self.defect == "shape":
            return cost[:, :-1]
        if self.defect == "scalar":
            return 3.0
        if self.defect == "nothing":
            return None
        if self.defect == "nan":
            return cost * torch.where(torch.arange(cost.shape[1]) == 2, torch.nan, 1.0)
        if self.defect == "complex":
            return cost * 1j
        if self.defect == "detached":
            return cost.detach()
        raise MyError("mine")


WRONG = [
    ("shape", ValueError, r"Wrong\.get_cost.*\(\d, 20\).*\(\d, 19\)"),
    ("scalar", ValueError, r"Wrong\.get_cost.*float"),
    ("nothing", ValueError, r"Wrong\.get_cost.*NoneType"),
    ("nan", ValueError, "NaN"),
    ("complex", ValueError, r"Wrong\.get_cost: expected real costs, got torch\.complex64"),
    ("raise", MyError, "^mine$"),
]


@pytest.mark.parametrize(("defect", "error", "words"), WRONG, ids=[defect for defect, _, _ in WRONG])
@pytest.mark.parametrize("solver", [solvers.CEMSolver, solvers.MPPISolver, solvers.GradientSolver])
def test_wrong_model_raises_an_error_with_the_reason(solver, defect, error, words):
    with pytest.raises(error, match=words):
        plan(few(solver, Wrong(defect)))


@pytest.mark.parametrize(("defect", "error", "words"), WRONG, ids=[defect for defect, _, _ in WRONG])
def test_wrong_model_stops_an_evaluation(defect, error, words):
    world = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(16, 16), max_episode_steps=8)
    world.set_policy(swm.policy.MPCPolicy(few(solvers.CEMSolver, Wrong(defect))))
    with pytest.raises(error, match=words):
        world.evaluate(episodes=2, seed=0, progress=False)
    # The world remains usable.
    world.set_policy(swm.policy.RandomPolicy(seed=0))
    assert len(world.evaluate(episodes=2, seed=0, progress=False)["steps"]) == 2


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: plan(solvers.CEMSolver()), ValueError, "model"),
        (lambda: plan(solvers.CEMSolver(object())), TypeError, "get_cost"),
        (lambda: solvers.CEMSolver(Quadratic(), samples_n=3), TypeError, "num_samples"),
        (lambda: solvers.CEMSolver(Quadratic(), model=Quadratic()), TypeError, "two names"),
        (lambda: solvers.CEMSolver(Quadratic()).solve(infos()), RuntimeError, "configure"),
        (lambda: plan(solvers.CEMSolver(Quadratic(), batch_size=0)), ValueError, "batch_size"),
        (lambda: plan(solvers.CEMSolver(Quadratic(), num_samples=0)), ValueError, "sample"),
        (lambda: plan(solvers.CEMSolver(Quadratic(), num_samples=8, topk=9)), ValueError, "elite"),
        (lambda: plan(solvers.GradientSolver(Wrong("detached"), num_samples=20)), ValueError, "differentiable"),
        (lambda: plan(solvers.GRASPSolver(Quadratic())), ValueError, "grasp|latent"),
        (lambda: plan(solvers.LagrangianSolver(Quadratic(), tolerance=-1)), ValueError, "tolerance"),
        (lambda: plan(solvers.CEMSolver(Prices()), space=CHOICES), ValueError, "continuous actions.*swm solvers"),
        (lambda: plan(solvers.PGDSolver(Quadratic())), ValueError, "PGDSolver plans discrete actions"),
        (lambda: solvers.GradientSolver(Quadratic(), optimizer_cls=torch.optim.RMSprop), ValueError, "adam|Adam"),
        (lambda: swm.PlanConfig(horizon=2, receding_horizon=3), ValueError, "execute"),
        (lambda: swm.policy.MPCPolicy(object()), TypeError, "configure"),
    ],
)
def test_wrong_arguments_raise_errors_with_the_reason(make, error, words):
    with pytest.raises(error, match=words):
        make()


WRONG_LENGTHS = [
    *((name, value) for name in ("horizon", "history_len", "action_block") for value in (0, 1.5, "many", None, True)),
    *(("warm_start", value) for value in ("yes", None, 2)),
    *(("latency_budget", value) for value in (0, -1.0, np.nan, np.inf, "1", True)),
]


@pytest.mark.parametrize(("name", "value"), WRONG_LENGTHS)
def test_wrong_plan_configs_name_the_field(name, value):
    with pytest.raises(ValueError, match=rf"PlanConfig\.{name}: .*; expected"):
        swm.PlanConfig(**{"receding_horizon": 1, name: value})


def test_numbers_of_numpy_are_those_of_python_in_settings_of_planning():
    config = swm.PlanConfig(np.int64(3), np.uint8(3), np.int32(1), np.array(1), np.bool_(True), np.float32(60.0))
    assert config == swm.PlanConfig(3, 3, 1, 1, True, 60.0)
    many = {"num_samples": 20, "n_steps": 3, "topk": 5, "var_scale": 0.5}
    numpy = {name: np.asarray(value)[()] for name, value in many.items()}
    assert np.array_equal(plan(solvers.CEMSolver(Quadratic(), **numpy)), plan(solvers.CEMSolver(Quadratic(), **many)))
    weight = {"from": np.float32(2.0), "to": np.float64(0.0)}
    assert solvers.GRASPSolver(Linear(), goal_weight=weight).settings["goal_weight"] == {"from": 2.0, "to": 0.0}
    world = rooms(2, steps=4)
    policy = swm.policy.MPCPolicy(solvers.CEMSolver(ToGoal(), **numpy), config)
    assert len(world.evaluate(policy=policy, episodes=2, seed=0, floor=False, progress=False)["steps"]) == 2
    with pytest.raises(ValueError, match="CEMSolver: var_scale=nan; expected a finite number"):
        solvers.CEMSolver(Quadratic(), var_scale=np.float32(np.nan))


# Planning in a `World`.


class ToGoal(torch.nn.Module):
    """A model whose cost has its minimum at an action along the straight line to the goal state."""

    def __init__(self, dtype=torch.float32):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.tensor(0.02, dtype=dtype))
        self.seen = []

    def get_cost(self, info_dict, action_candidates):
        self.seen.append({key: value for key, value in info_dict.items() if not key.startswith("_")})
        direction = (info_dict["goal_state"] - info_dict["state"])[:, :, -1] * self.weight
        return ((action_candidates.unflatten(-1, (-1, 2)).sum((2, 3)) - direction) ** 2).sum(-1)


class Wrapped:
    """A user-defined solver that calls a solver of the engine."""

    def __init__(self, solver):
        self.solver = solver

    def configure(self, **given):
        self.solver.configure(**given)

    def solve(self, info_dict, init_action=None):
        return self.solver.solve(info_dict, init_action)


def rooms(envs=2, steps=7):
    return swm.World("swm/TwoRoom-v1", num_envs=envs, image_shape=(16, 16), max_episode_steps=steps)


def played(policy, steps=18, envs=2):
    world = rooms(envs)
    world.set_policy(policy)
    world.reset(seed=4)
    actions, columns = [], world.infos
    for _ in range(steps):
        world.step()
        actions.append((columns["action"][:, 0].copy(), columns["state"][:, 0].copy(), columns["step_idx"].ravel().copy()))
    return [np.array(part) for part in zip(*actions, strict=True)]


@pytest.mark.parametrize("warm", [True, False])
@pytest.mark.parametrize("process", [False, True])
def test_engine_and_user_defined_solvers_execute_the_same_plans(warm, process):
    # Without noise, a search depends only on its initial actions: on warm starts and on the start of an episode.
    config = swm.PlanConfig(horizon=3, receding_horizon=2, action_block=2, warm_start=warm)
    scaler = swm.data.ZScoreScaler(np.array([0.1, -0.1], np.float32), np.array([0.5, 0.8], np.float32))
    settings = {"num_samples": 1, "n_steps": 3, "var_scale": 0.0}
    given = {"config": config, "process": {"action": scaler} if process else None}
    # The engine converts bounds to the model's units; user-defined solvers get the action space. Small actions
    # are inside the bounds in both.
    small = ToGoal()
    small.weight.data *= 0.02
    ours = played(swm.policy.MPCPolicy(solvers.GradientSolver(small, **settings), **given))
    python = played(swm.policy.MPCPolicy(Wrapped(solvers.GradientSolver(small, **settings)), **given))
    for one, other in zip(ours, python, strict=True):
        assert np.allclose(one, other, atol=1e-6, equal_nan=True)
    if not process:
        assert np.array_equal(ours[0], python[0], equal_nan=True)
    # The actions vary, and some episodes end.
    assert np.nanstd(ours[0]) > 1e-4 and (np.diff(ours[2], axis=0) < 0).any()


def test_plans_do_not_depend_on_other_environments():
    def policy(**more):
        return swm.policy.MPCPolicy(few(solvers.CEMSolver, ToGoal(), seed=1, **more), swm.PlanConfig(3, 2))

    alone, together = played(policy(), 7, envs=1), played(policy(batch_size=2), 7, envs=3)
    for one, other in zip(alone, together, strict=True):
        assert np.array_equal(one[:, 0], other[:, 0], equal_nan=True)


def test_planning_reaches_goals():
    # Within a room, every step moves the agent by the action times a speed.
    model = ToGoal()
    model.weight.data *= 5
    policy = swm.policy.MPCPolicy(solvers.CEMSolver(model, num_samples=60, n_steps=4, topk=8), swm.PlanConfig(2, 1))
    metrics = rooms(4, steps=120).evaluate(policy=policy, episodes=8, seed=0, progress=False)
    assert metrics["success_rate"] >= metrics["random_success_rate"] + 25, metrics
    assert metrics["plan_seconds"] and policy.plans[0].keys() >= {"episode", "slot", "replan", "cost", "best"}


def test_model_gets_scaled_infos():
    model = ToGoal(torch.float64)
    scaler = swm.data.ZScoreScaler(np.array([100.0, 50.0]), np.array([10.0, 20.0]))
    policy = swm.policy.MPCPolicy(
        few(solvers.CEMSolver, model),
        config=swm.PlanConfig(horizon=2, receding_horizon=1, history_len=3, action_block=2),
        process={"state": scaler},
        transform={"pixels": lambda image: image[:, ::2, ::2].float() / 255},
    )
    world = rooms(3)
    world.set_policy(policy)
    world.reset(seed=0)
    begun = world.infos["pixels"][:, 0].copy()
    states = []
    for _ in range(5):
        states.append(world.infos["state"].copy())
        world.step()
    first, last = model.seen[0], model.seen[-1]
    assert first["pixels"].shape == (3, 20, 3, 3, 8, 8) and first["pixels"].dtype == torch.float64
    assert first["goal"].shape == (3, 20, 1, 16, 16, 3) and first["goal"].dtype == torch.uint8
    # Before the first step, the history repeats the first frame.
    image = torch.from_numpy(begun).movedim(-1, 1)[:, :, ::2, ::2].double() / 255
    for frame in range(3):
        assert torch.allclose(first["pixels"][:, 0, frame], image)
    # Frames are one model step (two environment steps) apart, so the third plan has three different frames.
    assert torch.allclose(last["pixels"][:, 0, 0], image) and not torch.equal(last["pixels"][:, 0, 2], image)
    assert last["history_action"].shape == (3, 20, 2, 4)
    assert np.allclose(last["state"][:, 0], (states[4] - [100, 50]) / [10, 20])
    assert np.allclose(first["state"][:, 0], (states[0] - [100, 50]) / [10, 20])


def test_user_defined_solvers_get_the_history_that_the_engine_gives():
    config = swm.PlanConfig(2, 1, history_len=3, action_block=2, warm_start=False)
    scaler = swm.data.ZScoreScaler([0.1, -0.2], [2.0, 0.5])
    given = []
    for wrap in (Wrapped, lambda solver: solver):

        class Recorded(ToGoal):
            def get_cost(self, info_dict, action_candidates):
                names = ("pixels", "state", "action_history")
                seen[-1].append({name: info_dict[name][:, 0].numpy().copy() for name in names})
                return super().get_cost(info_dict, action_candidates)

        given.append(seen := [[]])
        policy = swm.policy.MPCPolicy(wrap(few(solvers.CEMSolver, Recorded())), config, process={"action": scaler})
        world = rooms(2, steps=30)
        world.set_policy(policy)
        world.reset(seed=3)
        for _ in range(8):
            world.step()
    # A search calls the model three times.
    ours, engine = given[0][0][::3], given[1][0][::3]
    assert len(ours) == len(engine) == 4
    for step, (one, other) in enumerate(zip(ours, engine, strict=True)):
        # The two paths draw different plans after the first one, so only what precedes it is equal.
        assert {name: value.shape for name, value in one.items()} == {name: value.shape for name, value in other.items()}
        if step == 0:
            assert all(np.array_equal(one[name], other[name]) for name in one)
            assert (one["action_history"] == 0).all() and (one["pixels"][:, 0] == one["pixels"][:, 2]).all()
    # A model step later, the newest past frame is the one of the step before.
    assert np.array_equal(ours[1]["pixels"][:, 1], ours[0]["pixels"][:, 2])
    assert np.array_equal(ours[3]["pixels"][:, :2], ours[2]["pixels"][:, 1:])
    assert np.array_equal(ours[3]["action_history"][:, 0], ours[2]["action_history"][:, 1])
    assert np.abs(ours[1]["action_history"][:, 1]).min() > 0


def test_nonlinear_scaler_converts_plans_back():
    class Cubic:
        def transform(self, x):
            return np.cbrt(x)

        def inverse_transform(self, x):
            return x**3

    class Half(torch.nn.Module):
        def get_cost(self, info_dict, action_candidates):
            return ((action_candidates - 0.5) ** 2).sum((2, 3))

    solver = solvers.GradientSolver(Half(), num_samples=1, n_steps=30, optimizer_cls="SGD", optimizer_kwargs={"lr": 0.2})
    policy = swm.policy.MPCPolicy(solver, swm.PlanConfig(1, 1), process={"action": Cubic()})
    world = rooms()
    world.set_policy(policy)
    world.reset(seed=0)
    world.step()
    assert np.allclose(world.infos["action"], 0.125, atol=0.01)


def test_discrete_actions_are_planned_and_executed():
    class Right(torch.nn.Module):
        def get_cost(self, info_dict, action_candidates):
            return -action_candidates.unflatten(-1, (-1, 2))[..., 1].sum((2, 3))

    config = swm.PlanConfig(horizon=3, receding_horizon=2, action_block=2)
    engine = solvers.CategoricalCEMSolver(Right(), num_samples=60, n_steps=4, topk=8)
    for solver in (engine, Wrapped(solvers.PGDSolver(Right()))):
        world = swm.World("swm/CartPoleControl-v1", num_envs=2, image_shape=(16, 16))
        world.set_policy(swm.policy.MPCPolicy(solver, config))
        world.reset(seed=0)
        for _ in range(5):
            world.step()
            assert (world.infos["action"] == 1).all()


class Choosing(gymnasium.Env):
    """An environment with any action space."""

    observation_space = gymnasium.spaces.Box(-9, 9, (2,), np.float32)

    def __init__(self, space, render_mode=None):
        self.action_space = space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action)
        return np.zeros(2, np.float32), 0.0, False, False, {}


class Last:
    """The cost of a candidate falls with the options that it chooses."""

    backend = "numpy"

    def get_cost(self, infos, candidates):
        return -(candidates * np.arange(candidates.shape[3], dtype=np.float32)).sum((2, 3))


@pytest.mark.parametrize("world", [{}, {"image_transform": lambda frame: frame}])
@pytest.mark.parametrize(
    ("space", "last"),
    [
        (gymnasium.spaces.MultiDiscrete([3, 4], start=[2, 5]), [4, 8]),
        (gymnasium.spaces.MultiDiscrete([[2, 2], [3, 3]]), [1, 1, 2, 2]),
        (gymnasium.spaces.MultiBinary(3), [1, 1, 1]),
        (gymnasium.spaces.Box(1, 4, (2,), np.uint8), [4, 4]),
    ],
)
def test_several_discrete_choices_are_planned_and_executed(space, last, world):
    gymnasium.register("Choosing-v0", entry_point=lambda **given: Choosing(space, **given), max_episode_steps=5)
    config = swm.PlanConfig(horizon=2, receding_horizon=1)
    try:
        with swm.World("Choosing-v0", num_envs=2, add_pixels=False, **world) as world:
            world.set_policy(swm.policy.MPCPolicy(solvers.CategoricalCEMSolver(Last(), num_samples=99, topk=9), config))
            world.reset(seed=0)
            world.step(2)
            assert world.infos["action"][:, 0].tolist() == [last] * 2
            world.set_policy(swm.policy.MPCPolicy(solvers.CEMSolver(Last()), config))
            with pytest.raises(ValueError, match="solver cem: it plans continuous actions"):
                world.step()
    finally:
        gymnasium.registry.pop("Choosing-v0")


class NumpyLinear:
    """A `Linear` of arrays."""

    latent_dim = 2

    def encode(self, info_dict):
        return np.asarray(info_dict["target"])[:, -1]

    encode_goal = encode

    def predict(self, latents, actions):
        return latents + np.asarray(actions)


def test_latent_dynamics_of_arrays_are_planned_with_but_have_no_gradient():
    dynamics = NumpyLinear()
    with pytest.raises(TypeError, match="NumpyLinear: encode and encode_goal give ndarray, ndarray; expected torch tensors"):
        plan(solvers.GRASPSolver(dynamics))
    dynamics.backend = "numpy"
    with pytest.raises(ValueError, match="solver grasp: it needs the gradient"):
        plan(solvers.GRASPSolver(dynamics))
    # The latent is the goal already.
    assert np.allclose(plan(solvers.CEMSolver(dynamics, num_samples=99, n_steps=20, topk=9)).sum(1), 0, atol=0.1)


SLOW = """
import sys, time
import stable_worldmodel as swm

class Slow:
    backend = "numpy"
    def get_cost(self, info_dict, action_candidates):
        print("planning", flush=True)
        time.sleep(30)

import gymnasium, numpy as np
solver = swm.solver.CEMSolver(Slow())
try:
    if sys.argv[1] == "solve":
        config = swm.PlanConfig(1, 1)
        solver.configure(action_space=gymnasium.spaces.Box(-1, 1, (2,)), n_envs=1, config=config)
        solver.solve({"state": np.zeros((1, 1, 2), np.float32)})
    else:
        world = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(16, 16))
        world.evaluate(policy=swm.policy.MPCPolicy(solver), episodes=2, progress=False)
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


@pytest.mark.parametrize("where", ["solve", "evaluate"])
def test_ctrl_c_interrupts_a_slow_model_within_seconds(where):
    child = subprocess.Popen([sys.executable, "-c", SLOW, where], stdout=subprocess.PIPE, text=True)
    try:
        assert child.stdout.readline().strip() == "planning"
        os.kill(child.pid, signal.SIGINT)
        assert child.communicate(timeout=4)[0].strip() == "interrupted" and child.returncode == 0
    finally:
        child.kill()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
def test_plans_on_gpu_and_cpu_agree():
    kinds = [(solvers.CEMSolver, Quadratic()), (solvers.GradientSolver, Quadratic()), (solvers.GRASPSolver, Linear())]
    for solver, model in kinds:
        on = [plan(few(solver, model.to(device), device=device)) for device in ("cpu", "cuda")]
        assert np.allclose(*on, atol=1e-4)


def test_policy_planned_in_python_belongs_to_the_world_that_took_it_last():
    class Still:
        def configure(self, **settings):
            self.envs = settings["n_envs"]

        def solve(self, infos, init_action=None):
            return {"actions": torch.zeros(self.envs, 4, 2)}

    policy = swm.policy.MPCPolicy(Still(), swm.policy.PlanConfig(horizon=4, receding_horizon=4))
    first, second = (swm.World("swm/TwoRoom-v1", num_envs=1, add_pixels=False) for _ in range(2))
    for world in (first, second):
        world.set_policy(policy)
        world.reset(seed=0)
    second.step()
    with pytest.raises(RuntimeError, match="MPCPolicy: another world took the policy"):
        first.step()
    first.set_policy(policy)
    first.step()


def test_policy_of_the_engine_plans_for_the_world_that_plays():
    """Another world, with other actions, took its solver meanwhile."""
    shapes = set()

    class Shapes(swm.solver.callbacks.Callback):
        def compute(self, candidates, action_low, **state):
            shapes.add((candidates.shape[3], len(action_low)))

    class Small:
        def get_cost(self, infos, candidates):
            return candidates.square().sum((2, 3))

    policy = swm.policy.MPCPolicy(few(solvers.ICEMSolver, Small(), callbacks=[Shapes()]), swm.PlanConfig(2, 2))
    first = swm.World("swm/TwoRoom-v1", num_envs=1, add_pixels=False, max_episode_steps=4)
    second = swm.World("swm/PendulumControl-v1", num_envs=1, add_pixels=False, max_episode_steps=4)
    first.set_policy(policy)
    second.set_policy(policy)
    for world, dim in ((first, 2), (second, 1), (first, 2)):
        shapes.clear()
        world.evaluate(episodes=1, seed=0, floor=False, progress=False)
        assert shapes == {(dim, dim)}


def test_candidates_that_a_model_keeps_do_not_change():
    """The engine fills arrays again that nothing refers to: not those of tensors, slices and views that are kept."""
    kept = []

    class Keeping:
        def get_cost(self, infos, candidates):
            for part in (candidates, candidates[:, 3:5], candidates.flatten(0, 1)[7]):
                kept.append((part, part.clone()))
            return candidates.square().sum((2, 3))

    class Slices(Keeping):
        backend = "numpy"

        def get_cost(self, infos, candidates):
            kept.extend((part, part.copy()) for part in (candidates[:, 1:2], candidates.reshape(-1)[5:9]))
            return np.square(candidates).sum((2, 3))

    space = gymnasium.spaces.Box(-1, 1, (2, 2), np.float32)
    for model in (Keeping(), Slices()):
        solver = solvers.CEMSolver(model, num_samples=20, n_steps=8, topk=4)
        solver.configure(action_space=space, n_envs=2, config=swm.PlanConfig(horizon=3, receding_horizon=3))
        solver.solve({"state": torch.zeros(2, 1)})
    assert len(kept) == 8 * 5
    assert all(bool((part == copy).all()) for part, copy in kept)


class Towards:
    """A cost model of Two-Room in numpy: the distance of the mean action from one that depends on the state."""

    backend = "numpy"

    def get_cost(self, infos, candidates):
        states = np.asarray(infos["state"]).reshape(*candidates.shape[:2], -1)[..., -2:]
        return ((candidates.mean(2) - np.sin(states)) ** 2).sum(-1)


def test_plans_from_python_depend_on_the_episode_alone():
    def played(world):
        buffer = swm.data.ReplayBuffer(1000)
        world.collect(writer=buffer, episodes=4, seed=0, progress=False)
        return [episode["action"] for episode in buffer.episodes()]

    def made(num_envs):
        world = swm.World(
            "swm/TwoRoom-v1", num_envs, image_shape=(32, 32), max_episode_steps=6, image_transform=lambda frame: frame
        )
        solver = swm.solver.CEMSolver(Towards(), num_samples=16, n_steps=3, topk=4)
        world.set_policy(swm.policy.MPCPolicy(solver, swm.PlanConfig(horizon=3, receding_horizon=2)))
        return world

    with made(1) as one, made(4) as four:
        expected = played(one)
        assert not np.array_equal(expected[0], expected[1])
        for again in (played(one), played(four)):
            for actions, of_first in zip(again, expected, strict=True):
                np.testing.assert_array_equal(actions, of_first)


class Nearest:
    """The cost of a candidate is its distance from 0.95 in the environment, of actions in units of a quarter."""

    def get_cost(self, infos, candidates):
        return ((candidates - 0.95 / 0.25) ** 2).sum((2, 3))


def executed(solver, process=None, settings=None, **world):
    """The first action that is executed."""
    with swm.World("swm/TwoRoom-v1", 1, **{"image_shape": (32, 32), **world}) as world:
        config = swm.PlanConfig(horizon=1, receding_horizon=1, **(settings or {}))
        world.set_policy(swm.policy.MPCPolicy(solver, config, process=process))
        world.reset(seed=0)
        world.step()
        return world.infos["action"][0, 0].copy()


def test_plans_from_python_have_the_bounds_of_scaled_actions():
    scaler = swm.data.ZScoreScaler(np.zeros(2), np.full(2, 0.25))
    for world in ({}, {"image_transform": lambda frame: frame}):
        solver = solvers.MPPISolver(Nearest(), num_samples=128, n_steps=20, seed=0)
        assert np.allclose(executed(solver, {"action": scaler}, **world), 0.95, atol=0.05)


def test_scaler_converts_actions_itself_where_it_is_not_its_mean_and_deviation():
    class Bent(swm.data.ZScoreScaler):
        def transform(self, actions):
            return np.arctanh(np.clip(actions, -0.99, 0.99))

        def inverse_transform(self, actions):
            return np.tanh(actions)

    class Half:
        def get_cost(self, infos, candidates):
            return ((candidates - 0.5) ** 2).sum((2, 3))

    solver = solvers.CEMSolver(Half(), num_samples=64, n_steps=20, topk=8, seed=0)
    assert np.allclose(executed(solver, {"action": Bent(np.zeros(2), np.ones(2) / 2)}), np.tanh(0.5), atol=0.02)


class Tensors:
    """A scaler whose mean and deviation are tensors, and which converts tensors only."""

    def __init__(self, kind):
        self.mean, self.std = kind(torch.zeros(2)), kind(torch.full((2,), 0.25))

    def transform(self, actions):
        return (actions - self.mean) / self.std

    def inverse_transform(self, actions):
        return actions * self.std + self.mean


@pytest.mark.skipif(torch is None, reason="needs torch")
@pytest.mark.parametrize("kind", ["tensors", "parameters"])
def test_scalers_of_tensors_plan_in_the_engine(kind):
    solver = solvers.MPPISolver(Nearest(), num_samples=128, n_steps=20, seed=0)
    scaler = Tensors(torch.nn.Parameter if kind == "parameters" else torch.as_tensor)
    assert np.allclose(executed(solver, {"action": scaler}), 0.95, atol=0.05)


def test_scalers_without_finite_bounds_do_not_bound_plans():
    class Logarithm:
        def transform(self, actions):
            return np.log(np.asarray(actions) + 0.5)

        def inverse_transform(self, plans):
            return np.exp(plans) - 0.5

    class Half:
        def get_cost(self, infos, candidates):
            return ((candidates - np.log(0.9)) ** 2).sum((2, 3))

    solver = solvers.CEMSolver(Half(), num_samples=128, n_steps=20, topk=8, seed=0)
    assert np.allclose(executed(solver, {"action": Logarithm()}), 0.4, atol=0.05)


@pytest.mark.parametrize("world", [{}, {"image_transform": lambda frame: frame}])
def test_searches_end_after_their_budget(world):
    class Slow:
        calls = 0

        def get_cost(self, infos, candidates):
            self.calls += 1
            time.sleep(0.05)
            return (candidates**2).sum((2, 3))

    model = Slow()
    executed(solvers.CEMSolver(model, num_samples=8, n_steps=200, topk=2), settings={"latency_budget": 0.1}, **world)
    assert model.calls < 100


def test_transforms_of_frames_reach_the_models_of_the_engine():
    actions = []
    for function in (lambda frame: frame, lambda frame: np.zeros_like(np.asarray(frame))):
        model = swm.wm.load("zoo:two-room/pldm")
        solver = solvers.CEMSolver(model, num_samples=32, n_steps=2, topk=4, seed=0)
        with swm.World("swm/TwoRoom-v1", 1, image_shape=(64, 64), image_transform=function) as world:
            config = swm.PlanConfig(horizon=1, receding_horizon=1, action_block=model.action_block)
            world.set_policy(swm.policy.MPCPolicy(solver, config))
            world.reset(seed=1)
            world.step()
            actions.append(world.infos["action"].copy())
    assert not np.allclose(*actions, atol=1e-2)


def test_models_get_no_goal_where_the_world_has_none():
    class Seen:
        def get_cost(self, infos, candidates):
            seen.update(infos)
            return (candidates**2).sum((2, 3))

    seen = {}
    for given in (True, False):
        seen.clear()
        executed(solvers.CEMSolver(Seen(), num_samples=8, n_steps=1, topk=2), goal_conditioned=given)
        assert ("goal" in seen) == given and "pixels" in seen
    model = swm.wm.load("zoo:two-room/pldm")
    solver = solvers.CEMSolver(model, num_samples=8, n_steps=1, topk=2)
    with pytest.raises(ValueError, match="'goal'"):
        executed(solver, settings={"action_block": model.action_block}, image_shape=(64, 64), goal_conditioned=False)


def test_mixtures_with_checkpoints_refuse_transforms_of_frames():
    with swm.World(
        "swm/CartpoleDMControl-v0", 1, add_pixels=False, task="swingup", image_transform=lambda frame: frame
    ) as world:
        world.set_policy(swm.policy.MixturePolicy({"random": 1, "zoo:cartpole-swingup/expert": 1}))
        world.reset(seed=1)
        with pytest.raises(ValueError, match="image_transform"):
            world.step()


def test_checkpoints_that_act_take_paths_and_no_scalers(tmp_path):
    model = swm.wm.load("zoo:cartpole-swingup/expert")
    path = pathlib.Path(model.path)
    assert swm.policy.FeedForwardPolicy(path).model == os.fspath(path)
    for given in ({"process": {"action": swm.data.ZScoreScaler(np.zeros(1), np.ones(1))}}, {"transform": {"pixels": abs}}):
        with pytest.raises(ValueError, match="remove process and transform"):
            swm.policy.FeedForwardPolicy(model, **given)


def test_callbacks_of_mppi_get_the_spread_of_the_candidates():
    seen = []

    class Watch(Callback):
        def __call__(self, **state):
            seen.append(
                (float(np.mean(np.asarray(state["prev_var"]))), float(np.asarray(state["candidates"])[0, 1:].std(0).mean()))
            )

    solver = solvers.MPPISolver(Nearest(), num_samples=2000, n_steps=3, var_scale=0.2, seed=1, callbacks=[Watch()])
    solver.configure(
        action_space=gymnasium.spaces.Box(-9, 9, (2,)), n_envs=1, config=swm.PlanConfig(horizon=3, receding_horizon=1)
    )
    solver.solve({"x": np.zeros((1, 1, 1))})
    assert len(seen) == 3
    assert all(abs(given - 0.2) < 1e-6 and abs(drawn - 0.2) < 0.02 for given, drawn in seen)


def test_plans_in_a_pool_end_with_their_episodes():
    class Rising:
        def get_cost(self, infos, candidates):
            wanted = np.linspace(-0.9, 0.9, candidates.shape[2])[:, None]
            return ((np.asarray(candidates) - wanted) ** 2).sum((2, 3))

    pool = EnvPool([lambda: gymnasium.make("swm/TwoRoom-v1", image_shape=(32, 32))] * 2)
    solver = solvers.CEMSolver(Rising(), num_samples=200, n_steps=15, topk=20, seed=0)
    policy = swm.policy.MPCPolicy(solver, swm.PlanConfig(horizon=5, receding_horizon=5))
    policy.set_env(pool)
    first = []
    for mask in (None, [True, False]):
        _, infos = pool.reset(seed=0, mask=mask)
        for _ in range(2):
            first.append(policy.get_action(infos)[:, 0])
            *_, infos = pool.step(np.stack([first[-1]] * 2, 1))
    # The first action of a plan is -0.9; the second environment goes on with its plan.
    expected = [[-0.9, -0.9], [-0.45, -0.45], [-0.9, 0.0], [-0.45, 0.45]]
    assert np.allclose(first, expected, atol=0.1)


class Still:
    """A cost whose cheapest plan rests."""

    backend = "numpy"

    def get_cost(self, infos, candidates):
        return np.square(candidates).sum((2, 3))


@pytest.mark.parametrize("length", [2**20, 2**36, 2**60])
def test_plans_too_long_for_memory_are_refused(length):
    space = gymnasium.spaces.Box(-1, 1, (1, 2))
    for wrong in (
        swm.PlanConfig(length, 1),
        swm.PlanConfig(1, 1, action_block=length),
        swm.PlanConfig(1, 1, history_len=length),
    ):
        with pytest.raises(ValueError, match=f"MPC .*: {length}; choose 1 to 10000"):
            solvers.CEMSolver(Still()).configure(action_space=space, n_envs=1, config=wrong)
        with pytest.raises(ValueError, match=f"MPC .*: {length}; choose 1 to 10000"):
            rooms().set_policy(swm.policy.MPCPolicy(solvers.CEMSolver(Still()), wrong))
    init = np.linspace(-0.9, 0.9, 20_000, dtype=np.float32).reshape(1, 10_000, 2)
    solver = solvers.CEMSolver(Still(), num_samples=4, var_scale=1e-4, n_steps=1, topk=2)
    solver.configure(action_space=space, n_envs=1, config=swm.PlanConfig(10_000, 1))
    solved = solver.solve({"x": np.zeros((1, 1), np.float32)}, init_action=init)["actions"]
    # With so little noise, the plan is the one that it starts from.
    assert solved.shape == init.shape and np.allclose(solved, init, atol=1e-3) and not np.array_equal(solved, init)


def test_configs_of_the_user_need_the_sizes_that_are_used():
    space = gymnasium.spaces.Box(-1, 1, (1, 2))
    for history in (None, 0):
        solver = solvers.CEMSolver(Still(), num_samples=4, n_steps=1, topk=2)
        config = SimpleNamespace(horizon=3, action_block=1, history_len=history)
        solver.configure(action_space=space, n_envs=1, config=config)
        assert solver.solve({"x": np.zeros((1, 1), np.float32)})["actions"].shape == (1, 3, 2)
    with pytest.raises(ValueError, match=r"config\.horizon: None; expected a whole number"):
        solver.configure(action_space=space, n_envs=1, config=SimpleNamespace(horizon=None, action_block=1))


class ScalarBox(gymnasium.Env):
    """An environment whose actions are scalars."""

    def __init__(self, render_mode=None):
        self.action_space = gymnasium.spaces.Box(-1, 1, (), np.float32)
        self.observation_space = gymnasium.spaces.Box(-1, 1, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        assert np.size(action) == 1
        return np.zeros(2, np.float32), 0.0, False, False, {}


if "ScalarBox-v0" not in gymnasium.registry:
    gymnasium.register("ScalarBox-v0", entry_point=ScalarBox, max_episode_steps=5)


@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("envs", [1, 2, 3])
def test_scalar_actions_have_one_dimension_for_any_number_of_environments(envs, own):
    solver = solvers.CEMSolver(Still(), num_samples=4, n_steps=2, topk=2)
    world = swm.World("ScalarBox-v0", envs, add_pixels=False)
    world.set_policy(swm.policy.MPCPolicy(Wrapped(solver) if own else solver, swm.PlanConfig(horizon=3, receding_horizon=2)))
    world.reset(seed=0)
    world.step(3)
    assert solver.action_dim == 1 and world.infos["action"].size == envs
    pool = EnvPool([ScalarBox] * envs)
    policy = swm.policy.MPCPolicy(solver, swm.PlanConfig(horizon=3, receding_horizon=2))
    policy.set_env(pool)
    pool.reset(seed=0)
    assert solver.action_dim == 1 and policy.get_action({"x": np.zeros((envs, 1, 1), np.float32)}).shape == (envs,)
    # A space with one axis is that of one environment.
    solver.configure(action_space=gymnasium.spaces.Box(-1, 1, (2,)), n_envs=2, config=swm.PlanConfig(1, 1))
    assert solver.action_dim == 2


def test_spaces_whose_rows_differ_are_those_of_no_equal_environments():
    box = gymnasium.spaces.Box(np.float32([[-1, -1], [-5, -9]]), np.float32([[1, 1], [5, 9]]))
    choices = gymnasium.spaces.MultiDiscrete([[3, 2], [4, 5]])
    for space, kind in ((box, solvers.CEMSolver), (choices, solvers.CategoricalCEMSolver)):
        solver = kind(Still(), num_samples=4, n_steps=2, topk=2)
        with pytest.raises(ValueError, match="rows that differ"):
            solver.configure(action_space=space, n_envs=2, config=swm.PlanConfig(1, 1))
            solver.solve({"x": np.zeros((2, 1, 1), np.float32)})


def test_plans_of_whole_numbers_with_many_options_are_rounded():
    class Wide:
        action_space, num_envs = gymnasium.spaces.Box(0, 2**21, (1, 2), np.int32), 1

    class Numbers:
        def configure(self, **given):
            pass

        def solve(self, infos, init_action=None):
            return {"actions": np.array([[[2.6, 2.0**22]]])}

    policy = swm.policy.MPCPolicy(Numbers(), swm.PlanConfig(1, 1))
    policy.set_env(Wide())
    assert policy.get_action({"x": np.zeros((1, 1, 1), np.float32)}).tolist() == [[3, 2**21]]


def test_warm_starts_are_those_of_the_environment_though_a_solver_reuses_its_plans():
    class Reusing:
        plans, starts = np.zeros((2, 2, 2), np.float32), []

        def configure(self, **given):
            pass

        def solve(self, infos, init_action=None):
            count = len(infos["x"])
            if init_action is not None:
                self.starts.append(np.asarray(init_action)[:, 0, 0].tolist())
            self.plans[:count] = np.asarray(infos["x"])[:, :, :1]
            return {"actions": self.plans[:count]}

    class Two:
        action_space, num_envs = gymnasium.spaces.Box(-9, 9, (2, 2), np.float32), 2

    solver = Reusing()
    policy = swm.policy.MPCPolicy(solver, swm.PlanConfig(2, 1))
    policy.set_env(Two())
    x = np.float32([[[3.0]], [[5.0]]])
    policy.get_action({"x": x})
    # The second environment alone, then both.
    policy.get_action({"x": x, "_active": np.array([False, True])})
    policy.get_action({"x": x})
    assert solver.starts == [[5.0], [3.0, 5.0]]


def test_masked_plans_and_costs_are_refused():
    class Masked:
        def get_cost(self, infos, candidates):
            return np.ma.array(np.zeros(candidates.shape[:2]), mask=True)

    box = gymnasium.spaces.Box(-1, 1, (1, 2), np.float32)
    solver = solvers.CEMSolver(Masked(), num_samples=4, n_steps=2, topk=2)
    solver.configure(action_space=box, n_envs=1, config=swm.PlanConfig(1, 1))
    infos = {"x": np.zeros((1, 1, 1), np.float32)}
    with pytest.raises(ValueError, match="expected real numbers without masked values"):
        solver.solve(infos, init_action=np.ma.array(np.zeros((1, 1, 2)), mask=True))
    with pytest.raises(ValueError, match="expected real numbers without masked values, got complex"):
        solver.solve(infos, init_action=np.full((1, 1, 2), 1j))


def test_complex_plans_are_refused():
    class Phases:
        def configure(self, **given):
            pass

        def solve(self, infos, init_action=None):
            return {"actions": np.full((2, 1, 2), 0.5 + 1j)}

    world = rooms()
    world.set_policy(swm.policy.MPCPolicy(Phases(), swm.PlanConfig(1, 1)))
    world.reset(seed=0)
    with pytest.raises(ValueError, match="expected real actions, got complex numbers"):
        world.step()
