"""Tests of objectives, evaluators and callbacks of solvers."""

import dataclasses
import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import stable_worldmodel as swm

torch = pytest.importorskip("torch")
torch.set_num_threads(1)

import gymnasium  # noqa: E402

from stable_worldmodel import _engine, planning  # noqa: E402
from stable_worldmodel.planning.solver import callbacks as hooks  # noqa: E402
from stable_worldmodel.planning.solver.utils import prepare_init_action  # noqa: E402

BOX = gymnasium.spaces.Box(-1, 1, (3, 2), np.float32)
TARGETS = torch.tensor([[0.5, -0.3], [-0.6, 0.2], [0.1, 0.8]])


class Sums(torch.nn.Module):
    """A `Dynamics` whose embedding is the state, to which every action is added."""

    def __init__(self):
        super().__init__()
        self.encoded = 0

    def encode(self, info):
        self.encoded += 1
        info["emb"] = info["pixels"].float()
        return info

    def rollout(self, info, action_candidates):
        start = info["state"][:, :, -1:]
        info["predicted_emb"] = torch.cat([start, start + action_candidates.cumsum(2)], 2)
        return info


class ToTarget:
    def get_cost(self, info_dict, action_candidates):
        return (action_candidates - info_dict["target"][:, :, -1:]).square().sum((2, 3))


def infos():
    return {"goal": TARGETS[:, None], "state": torch.zeros(3, 1, 2), "target": TARGETS[:, None]}


def configured(solver, horizon=3, space=BOX):
    solver.configure(action_space=space, n_envs=3, config=swm.PlanConfig(horizon, horizon))
    return solver


def test_an_evaluator_plans_to_the_goal():
    model = Sums()
    cost = planning.ShootingCostEvaluator(model, planning.GoalMSE())
    solver = configured(planning.CEMSolver(cost=cost, num_samples=200, n_steps=15, topk=20))
    plan = solver(infos())["actions"]
    assert (plan.sum(1) - TARGETS).abs().max() < 0.05
    assert model.encoded == 1, "the goal is encoded once for a search"
    # The penalty prefers equal small actions: for a distance d, the optimum of (d - 3a)^2 + 3 w a^2 is a = d / (3 + w).
    weighted = planning.WeightedSum([(1.0, planning.GoalMSE()), (0.5, planning.ControlPenalty())])
    cost = planning.ShootingCostEvaluator(model, weighted)
    solver = planning.GradientSolver(cost=cost, n_steps=200, num_samples=2)
    plan = configured(solver).solve(infos())["actions"]
    assert (plan - (TARGETS / 3.5)[:, None]).abs().max() < 0.01


def test_constraints_make_an_evaluator_constrainable():
    class Least(torch.nn.Module):
        """At most 0.2 for the first element of the last action."""

        def forward(self, info_dict):
            return info_dict["action_candidates"][..., -1, 0] - 0.2

    cost = planning.ShootingCostEvaluator(Sums(), planning.GoalMSE(), constraints=[Least()])
    assert isinstance(cost, planning.Constrainable) and isinstance(cost, planning.Costable)
    assert not isinstance(planning.ShootingCostEvaluator(Sums(), planning.GoalMSE()), planning.Constrainable)
    given = {key: value[:, None].expand(-1, 4, *value.shape[1:]) for key, value in infos().items()}
    assert cost.get_constraints(given, torch.zeros(3, 4, 3, 2)).tolist() == [[[pytest.approx(-0.2)]] * 4] * 3
    far = {**infos(), "goal": torch.tensor([[[2.0, 0.0]]] * 3)}
    plan = configured(planning.LagrangianSolver(cost, num_samples=4, n_outer_steps=8)).solve(far)["actions"]
    assert plan[:, -1, 0].max() < 0.21 and (plan.sum(1)[:, 0] - 2).abs().max() < 0.05


def test_objectives_by_hand():
    predicted = torch.tensor([[[[9.0, 9.0], [1.0, 2.0]], [[9.0, 9.0], [0.0, 0.0]]]])
    goals = torch.tensor([[[7.0, 7.0], [1.0, 0.0]]])
    given = {"predicted_emb": predicted, "goal_emb": goals, "action_candidates": torch.full((1, 2, 3, 2), 2.0)}
    assert planning.GoalMSE()(given).tolist() == [[4.0, 1.0]]
    assert planning.GoalMSE(reduction="mean")(given).tolist() == [[2.0, 0.5]]
    assert planning.GoalMSE()({**given, "goal_emb": goals[:, None].expand(-1, 2, -1, -1)}).tolist() == [[4.0, 1.0]]
    assert planning.ControlPenalty()(given).tolist() == [[24.0, 24.0]]
    total = planning.WeightedSum([(2.0, planning.GoalMSE()), (0.5, planning.ControlPenalty())])
    assert total(given).tolist() == [[20.0, 14.0]]
    with pytest.raises(KeyError, match="'predicted_emb'"):
        planning.GoalMSE()({})
    with pytest.raises(ValueError, match="no terms"):
        planning.WeightedSum([])
    with pytest.raises(TypeError, match="encode.*rollout"):
        planning.ShootingCostEvaluator(ToTarget(), planning.GoalMSE())


def test_callbacks_see_every_iteration():
    states = []

    class Keep(hooks.Callback):
        name = "kept"

        def compute(self, **state):
            states.append(state)
            return state["step"]

    recorders = [hooks.BestCostRecorder("none"), hooks.MeanCostRecorder(), hooks.EliteCostRecorder(), Keep()]
    recorders += [hooks.VarNormRecorder(), hooks.MeanShiftRecorder(), hooks.EliteSpreadRecorder()]
    settings = {"num_samples": 50, "n_steps": 4, "topk": 10, "seed": 7}
    solver = configured(planning.CEMSolver(ToTarget(), callbacks=recorders, **settings))
    found = solver.solve(infos())
    # Callbacks change nothing, and agree with the engine's own trace.
    plain = configured(planning.CEMSolver(ToTarget(), **settings)).solve(infos())
    assert torch.equal(found["actions"], plain["actions"])
    history = found["callbacks"]
    assert history["kept"] == [[0, 1, 2, 3]]
    best = np.array(history["BestCostRecorder"][0])
    assert best.shape == (4, 3) and np.allclose(best.T, [trace["best"] for trace in plain["trace"]])
    assert np.allclose(history["EliteCostRecorder"][0][1]["min"], best[1].mean())
    last = states[-1]
    assert last["candidates"].shape == (3, 50, 3, 2) and last["topk_candidates"].shape == (3, 10, 3, 2)
    assert (last["topk_vals"].diff(dim=1) >= 0).all()
    assert torch.allclose(last["costs"].gather(1, last["topk_inds"]), last["topk_vals"])
    # The mean after the last iteration is the plan, and the mean before an iteration is the one after the one before.
    assert torch.allclose(last["mean"], found["actions"], atol=1e-6)
    assert torch.allclose(last["prev_mean"], states[-2]["mean"], atol=1e-6)
    assert torch.allclose(last["var"], last["topk_candidates"].std(1), atol=1e-5)
    spread = history["VarNormRecorder"][0]
    assert spread[0] > spread[-1] and np.isclose(history["EliteSpreadRecorder"][0][-1], spread[-1], rtol=1e-5)
    solver.solve(infos())
    assert len(recorders[0].history) == 1, "each search begins a new history"


@pytest.mark.parametrize(
    ("solver", "settings", "space"),
    [
        (planning.CEMSolver, {"topk": 10, "num_samples": 50}, BOX),
        (planning.ICEMSolver, {"topk": 10, "num_samples": 50}, BOX),
        (planning.MPPISolver, {"topk": 10, "num_samples": 50}, BOX),
        (planning.GradientSolver, {"num_samples": 4}, BOX),
        (planning.CategoricalCEMSolver, {"topk": 10, "num_samples": 50}, gymnasium.spaces.MultiDiscrete([[2]] * 3)),
    ],
    ids=["cem", "icem", "mppi", "gd", "categorical"],
)
def test_a_callback_ends_the_search_with_the_plan_so_far(solver, settings, space):
    calls = []

    class Third(hooks.Callback):
        def compute(self, **state):
            calls.append(state["step"])
            if state["step"] == 2:
                raise hooks.StopSearch
            return 1.0

    class Counted(ToTarget):
        calls = 0

        def get_cost(self, info_dict, action_candidates):
            Counted.calls += 1
            return super().get_cost(info_dict, action_candidates)

    stopped = configured(solver(Counted(), n_steps=20, callbacks=[Third()], seed=3, **settings), space=space).solve(infos())
    evaluated = Counted.calls
    short = configured(solver(ToTarget(), n_steps=3, seed=3, **settings), space=space).solve(infos())
    assert torch.equal(stopped["actions"], short["actions"]) and stopped["costs"] == short["costs"]
    assert calls == [0, 1, 2] and stopped["callbacks"] == {"Third": [[1.0, 1.0]]}
    # The gradient solvers compare their candidates once more at the end.
    assert evaluated == (4 if solver is planning.GradientSolver else 3)


@pytest.mark.parametrize("init", [None, np.full((3, 3, 2), 0.4, np.float32)], ids=["zeros", "init"])
@pytest.mark.parametrize(
    ("solver", "settings"),
    [
        (planning.CEMSolver, {"topk": 10}),
        (planning.CEMSolver, {"topk": 2}),
        (planning.ICEMSolver, {"topk": 10, "alpha": 0.3}),
        (planning.MPPISolver, {"topk": 10, "temperature": 0.05}),
        (planning.MPPISolver, {"topk": 50, "var_scale": 0.3}),
        (planning.MPPISolver, {"topk": 1}),
        (planning.PredictiveSamplingSolver, {"noise_scale": 0.3}),
    ],
)
def test_callbacks_get_the_moments_of_the_solver(solver, settings, init):
    keep, spread, shift = Keep(), hooks.VarNormRecorder("none"), hooks.MeanShiftRecorder()
    steps = {} if solver is planning.PredictiveSamplingSolver else {"n_steps": 5}
    search = configured(solver(ToTarget(), num_samples=50, seed=3, callbacks=[keep, spread, shift], **steps, **settings))
    found = search.solve(infos(), init_action=init)
    means = [state["prev_mean"] for state in keep.states] + [found["actions"]]
    assert len(means) == 1 + steps.get("n_steps", 1)
    for state, mean, next_mean in zip(keep.states, means, means[1:], strict=False):
        # The first candidate is the mean that the engine draws around.
        assert torch.equal(mean, state["candidates"][:, 0]) and torch.allclose(state["mean"], next_mean, rtol=0, atol=1e-6)
    for state, following in zip(keep.states, keep.states[1:], strict=False):
        assert torch.equal(state["var"], following["prev_var"])
    moved = [float((after - before).flatten(1).norm(dim=1).mean()) for before, after in zip(means, means[1:], strict=False)]
    assert np.allclose(found["callbacks"]["MeanShiftRecorder"][0], moved, rtol=0, atol=1e-5)
    trace = [search["spread"] for search in found["trace"]]
    assert np.allclose(np.transpose(found["callbacks"]["VarNormRecorder"][0]), trace, rtol=1e-5)


@pytest.mark.parametrize("alpha", [0.0, 0.6])
@pytest.mark.parametrize("init", [None, [[1, 0, 2], [2, -1, 2], [0, 2, 1]]], ids=["uniform", "init"])
def test_callbacks_get_the_probabilities_of_the_solver(alpha, init):
    class Mixed:
        def get_cost(self, info_dict, action_candidates):
            return (action_candidates * torch.arange(18.0).sin().reshape(3, 6)).sum((2, 3))

    keep = Keep()
    space = gymnasium.spaces.MultiDiscrete([[3]] * 3)
    few = {"num_samples": 60, "n_steps": 4, "topk": 25, "smoothing": 0.05, "seed": 3}
    solver = planning.CategoricalCEMSolver(Mixed(), alpha=alpha, callbacks=[keep], **few)
    solver.configure(action_space=space, n_envs=3, config=swm.PlanConfig(3, 3, action_block=2))
    init = None if init is None else np.repeat(np.asarray(init)[..., None], 2, -1)
    found = solver.solve(infos(), init_action=init)
    # The first candidate has the most probable options, from which the plan is made.
    flat = [state["prev_probs"] for state in keep.states] + [keep.states[-1]["probs"]]
    for state, probs, following in zip(keep.states, flat, flat[1:], strict=False):
        mode = state["candidates"][:, 0].reshape(probs.shape)
        assert torch.equal(probs.argmax(-1), mode.argmax(-1)) and torch.equal(state["probs"], following)
    assert torch.equal(flat[-1].argmax(-1), found["actions"])
    # The engine's trace has the probability that two draws of a choice differ.
    differ = [1 - state["probs"].square().sum(-1).mean((1, 2)) for state in keep.states]
    assert np.allclose(torch.stack(differ, 1), [search["spread"] for search in found["trace"]], atol=1e-5)
    assert torch.equal(found["probs"][0], flat[-1])


@pytest.mark.parametrize(
    ("solver", "recorder", "missing"),
    [
        (planning.CEMSolver, hooks.ActionNormRecorder, "params"),
        (planning.GradientSolver, hooks.EliteCostRecorder, "topk_vals"),
    ],
)
def test_recorders_of_another_solver_are_named(solver, recorder, missing):
    with pytest.raises(ValueError, match=f"{recorder.__name__}: reads '{missing}', which the state of this solver"):
        configured(solver(ToTarget(), callbacks=[recorder()], num_samples=64)).solve(infos())


def test_a_single_elite_has_no_spread():
    for solver, settings in ((planning.MPPISolver, {"topk": 1, "n_steps": 2}), (planning.PredictiveSamplingSolver, {})):
        found = configured(solver(ToTarget(), callbacks=[hooks.EliteSpreadRecorder()], **settings)).solve(infos())
        assert found["callbacks"]["EliteSpreadRecorder"] == [[0.0] * settings.get("n_steps", 1)]


def test_callbacks_with_the_same_key_all_have_a_history():
    recorders = [hooks.BestCostRecorder(kind) for kind in ("none", "mean", "sum")]
    recorders.append(hooks.MeanCostRecorder())
    recorders[2].name = "BestCostRecorder_2"
    solver = configured(planning.CEMSolver(ToTarget(), n_steps=2, callbacks=recorders))
    found = solver.solve(infos())["callbacks"]
    keys = ["BestCostRecorder", "BestCostRecorder_3", "BestCostRecorder_2", "MeanCostRecorder"]
    assert found == {key: recorder.history for key, recorder in zip(keys, recorders, strict=True)}


def test_gradient_recorders():
    recorders = [hooks.GradNormRecorder("none"), hooks.GradNormRecorder(per_step=True), hooks.ActionNormRecorder("sum")]
    recorders[1].name = "steps"
    solver = planning.GradientSolver(ToTarget(), n_steps=1, num_samples=1, callbacks=recorders)
    history = configured(solver).solve(infos(), init_action=np.zeros((3, 3, 2), np.float32))["callbacks"]
    # At zero actions, the gradient of |a - t|^2 is -2 t in each of the three steps.
    lengths = 2 * TARGETS.norm(dim=1)
    assert np.allclose(history["GradNormRecorder"][0][0], 3**0.5 * lengths)
    assert np.allclose(history["steps"][0][0], [float(lengths.mean())] * 3)
    assert history["ActionNormRecorder"] == [[0.0]]
    params = torch.ones(2, 1, 3, 2, requires_grad=True)
    assert hooks.GradNormRecorder()(params=params) is None
    assert hooks.ActionNormRecorder("sum").compute(params=params) == pytest.approx(2 * 6**0.5)
    with pytest.raises(ValueError, match="reduction"):
        hooks.Callback("median")


def test_callbacks_run_in_a_world():
    class Distance:
        def get_cost(self, info_dict, action_candidates):
            return (action_candidates - 0.5).square().sum((2, 3))

    recorder = hooks.BestCostRecorder()
    solver = planning.CEMSolver(Distance(), num_samples=20, n_steps=3, topk=5, callbacks=[recorder])
    world = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(16, 16))
    metrics = world.evaluate(
        policy=swm.policy.WorldModelPolicy(solver, swm.PlanConfig(2, 2)), episodes=2, seed=0, floor=False, progress=False
    )
    assert len(metrics["seeds"]) == 2 and len(recorder.history) == 1 and len(recorder.history[0]) == 3


class Keep(hooks.Callback):
    """Keeps the state of every iteration, and ends the search after `stop` of them."""

    def __init__(self, stop=None):
        super().__init__()
        self.states, self.stop = [], stop

    def compute(self, **state):
        self.states.append(state)
        if len(self.states) == self.stop:
            raise hooks.StopSearch
        return float(state["costs"].min())


def test_callbacks_read_the_lagrangian_search():
    class Limited(ToTarget):
        def get_constraints(self, info_dict, action_candidates):
            return action_candidates[..., 0] - 0.2

    few = {"n_steps": 4, "n_outer_steps": 3, "num_samples": 2, "seed": 3}
    keep = Keep()
    found = configured(planning.LagrangianSolver(Limited(), callbacks=[keep], **few)).solve(infos())
    plain = configured(planning.LagrangianSolver(Limited(), **few)).solve(infos())
    assert torch.equal(found["actions"], plain["actions"]) and [state["step"] for state in keep.states] == list(range(12))
    assert keep.states[0]["gradient"].shape == (3, 2, 3, 2) and found["callbacks"]["Keep"] == [keep.history[0]]
    # The constraint is active where the target is beyond the limit, at 0.5, and only there.
    multipliers = found["multipliers"]
    assert torch.equal(multipliers, plain["multipliers"]) and multipliers.shape == (3, 3)
    assert (multipliers[0] > 0).all() and (multipliers[1:] == 0).all()
    stopped = configured(planning.LagrangianSolver(Limited(), callbacks=[Keep(stop=4)], **few)).solve(infos())
    short = configured(planning.LagrangianSolver(Limited(), **{**few, "n_outer_steps": 1})).solve(infos())
    assert torch.equal(stopped["actions"], short["actions"])


def test_callbacks_read_the_search_of_grasp():
    class Adds(torch.nn.Module):
        latent_dim = 2

        def encode(self, info_dict):
            return info_dict["state"][:, -1]

        def encode_goal(self, info_dict):
            return info_dict["goal"][:, -1]

        def predict(self, latents, actions):
            return latents + actions

    few = {"n_steps": 6, "sync_every": 3, "sync_iterations": 2}
    keep = Keep()
    found = configured(planning.GRASPSolver(Adds(), callbacks=[keep], **few)).solve(infos())
    plain = configured(planning.GRASPSolver(Adds(), **few)).solve(infos())
    assert torch.equal(found["actions"], plain["actions"])
    # Six iterations, and two steps in each of the two synchronisations.
    assert [state["step"] for state in keep.states] == list(range(10)) and keep.states[0]["costs"].shape == (3, 1)
    # At the start, the plan is zero and the states lie on the line to the goal: the loss of three steps of a third of the
    # way each, and twice the distance to the goal, which no step reduces.
    first = 3 * (TARGETS / 3).square().sum(1) + 2 * torch.tensor([1.0, 4 / 9, 1 / 9]).sum() * TARGETS.square().sum(1)
    assert torch.allclose(keep.states[0]["costs"][:, 0], first, rtol=1e-5)
    calls = Keep(stop=2)
    configured(planning.GRASPSolver(Adds(), callbacks=[calls], **few)).solve(infos())
    assert len(calls.states) == 2


def test_callbacks_read_searches_inside_of_the_engine():
    def played(callbacks):
        solver = planning.CEMSolver("simulator", num_samples=16, n_steps=3, topk=4, seed=1, callbacks=callbacks)
        policy = swm.policy.WorldModelPolicy(solver, swm.PlanConfig(2, 2))
        world = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(16, 16), max_episode_steps=6)
        outcome = world.evaluate(policy=policy, episodes=2, seed=0, floor=False, progress=False)
        return outcome["steps"].tolist(), [plan["best"] for plan in policy.plans]

    keep = Keep()
    steps, best = played([keep])
    assert (steps, best) == played([]), "callbacks change no plan"
    # Both environments are planned for together; the states of the last search are those of the last two plans.
    assert len(keep.history) == 1 and len(keep.history[0]) == 3
    last = torch.stack([state["costs"].min(1).values for state in keep.states[-3:]])
    assert last.T.tolist() == best[-len(last.T) :] and keep.states[-1]["candidates"].shape[1:] == (16, 2, 2)
    assert torch.equal(keep.states[-1]["costs"].gather(1, keep.states[-1]["topk_inds"]), keep.states[-1]["topk_vals"])

    class Wrong(Exception):
        pass

    class Raises(hooks.Callback):
        def compute(self, **state):
            raise Wrong("in the callback")

    with pytest.raises(Wrong, match="in the callback"):
        played([Raises()])


def test_constructors_have_the_defaults_of_the_engine():
    known = json.loads(_engine.solvers())
    for solver in (
        planning.CEMSolver,
        planning.ICEMSolver,
        planning.MPPISolver,
        planning.PredictiveSamplingSolver,
        planning.CategoricalCEMSolver,
        planning.GradientSolver,
        planning.PGDSolver,
        planning.LagrangianSolver,
    ):
        for name, value in solver(ToTarget()).settings.items():
            assert value == pytest.approx(known[solver.id][name]) if value is not None else known[solver.id][name] is None


def test_solvers_have_the_properties_of_the_protocol():
    solver = planning.CEMSolver(ToTarget(), 2, 64, var_scale=0.5)
    assert not isinstance(solver, planning.Solver) or solver.n_envs == 0
    configured(solver)
    assert isinstance(solver, planning.Solver) and (solver.n_envs, solver.horizon, solver.action_dim) == (3, 3, 2)
    assert (solver.num_samples, solver.batch_size, solver.var_scale, solver.dtype) == (64, 2, 0.5, torch.float32)
    mean, spread = solver.init_action_distrib(3, torch.ones(3, 1, 2))
    assert mean[:, 0].eq(1).all() and mean[:, 1:].eq(0).all() and spread.eq(0.5).all() and spread.shape == (3, 3, 2)
    with pytest.raises(AttributeError, match="nothing"):
        _ = solver.nothing
    discrete = configured(planning.CategoricalCEMSolver(ToTarget()), space=gymnasium.spaces.MultiDiscrete([[2, 4]] * 3))
    assert discrete.action_simplex_dim == 6 and discrete.init_probs(2)[1, 0].tolist() == [0.5, 0.5, *[0.25] * 4]
    assert swm.solver.callbacks is hooks and swm.solver.CEMSolver is planning.CEMSolver


def test_initial_actions_are_extended_by_zeros_or_by_the_policy_of_the_model():
    class Acts:
        def get_action(self, info, horizon=1, prefix_actions=None):
            count = 0 if prefix_actions is None else prefix_actions.shape[1]
            return torch.full((2, horizon, 3), float(count))

    given = torch.full((2, 1, 3), 9.0)
    assert prepare_init_action(None, {}, given, 3, 2, 3)[0, :, 0].tolist() == [9, 0, 0]
    assert prepare_init_action(Acts(), {}, given, 3, 2, 3)[0, :, 0].tolist() == [9, 1, 1]
    assert prepare_init_action(Acts(), {}, None, 3, 2, 3)[0, :, 0].tolist() == [0, 0, 0]
    assert prepare_init_action(None, {}, given, 1, 2, 3) is given
    with pytest.raises(ValueError, match=r"\(2, 1, 3\)"):
        prepare_init_action(None, {}, given, 3, 2, 4)


def test_costs_in_a_reused_buffer_belong_to_their_environments():
    class Reusing(torch.nn.Module):
        def __init__(self, kind):
            super().__init__()
            self.out, self.backend = torch.empty(1000), kind

        def get_cost(self, info_dict, action_candidates):
            out = self.out[: action_candidates.shape[0] * action_candidates.shape[1]].view(action_candidates.shape[:2])
            with torch.no_grad():
                out.copy_(ToTarget().get_cost(*map(as_tensors, (info_dict, action_candidates))))
            return out if self.backend == "torch" else out.numpy()

    def as_tensors(given):
        return (
            {key: torch.as_tensor(value) for key, value in given.items()} if isinstance(given, dict) else torch.as_tensor(given)
        )

    for kind in ("torch", "numpy"):
        plans = []
        for size in (None, 1, 2):
            solver = planning.CEMSolver(Reusing(kind), batch_size=size, num_samples=100, n_steps=15, topk=10, seed=0)
            solver.configure(action_space=BOX, n_envs=3, config=swm.PlanConfig(1, 1))
            plans.append(solver.solve(infos())["actions"])
        assert (plans[0][:, 0] - TARGETS).abs().max() < 0.05
        assert torch.equal(plans[0], plans[1]) and torch.equal(plans[0], plans[2]), kind


def test_gradient_solvers_search_within_inference_mode():
    solver = configured(planning.GradientSolver(ToTarget(), n_steps=100, num_samples=2))
    with torch.inference_mode():
        plan = solver.solve({key: value.clone() for key, value in infos().items()})["actions"]
    assert (plan - TARGETS[:, None]).abs().max() < 0.1


def test_threads_that_share_a_solver_get_numbers_of_their_own():
    solver = configured(planning.CEMSolver(ToTarget(), num_samples=8, n_steps=1, topk=2))
    with ThreadPoolExecutor(4) as threads:
        plans = list(threads.map(lambda _: solver.solve(infos())["actions"].numpy().tobytes(), range(40)))
    assert len(set(plans)) == 40


def test_complex_costs_of_a_model_with_complex_parameters_are_refused():
    class Complex(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = torch.nn.Parameter(torch.ones(1, dtype=torch.complex64))

        def get_cost(self, info_dict, action_candidates):
            return (action_candidates * self.weight).sum((2, 3))

    with pytest.raises(ValueError, match="expected real costs, got torch.complex64"):
        configured(planning.CEMSolver(Complex(), num_samples=8, n_steps=2, topk=3)).solve(infos())


def test_solvers_name_what_they_cannot_plan_with():
    class Plain:
        def get_cost(self, infos, candidates):
            return candidates.square().sum((-1, -2))

    for seed in (-1, 1.5, "a"):
        with pytest.raises(ValueError, match="seed: .*; expected a whole number of at least 0"):
            swm.solver.CEMSolver("simulator", seed=seed)
    for size in (0, 1.5, "a"):
        with pytest.raises(ValueError, match="batch_size: .*; expected a whole number of at least 1"):
            swm.solver.CEMSolver("simulator", batch_size=size)
    solver = swm.solver.CEMSolver(Plain(), num_samples=8, n_steps=1, topk=2)
    solver.configure(action_space=BOX, n_envs=3, config=swm.PlanConfig(horizon=2, receding_horizon=1))
    for infos, error in (({}, ValueError), ({"words": ["a"]}, ValueError), ([], TypeError)):
        with pytest.raises(error, match="info_dict: .*expected"):
            solver.solve(infos)
    solver.configure(action_space=gymnasium.spaces.MultiBinary(3), n_envs=1, config=swm.PlanConfig(2, 1))
    with pytest.raises(TypeError, match=r"MultiBinary\(3\); planners choose actions of Box"):
        solver.solve({"state": np.zeros((1, 1, 2), np.float32)})


def test_plan_configurations_with_fields_of_their_own_plan():
    @dataclasses.dataclass(frozen=True)
    class Named(swm.PlanConfig):
        name: str = "short"

    solver = swm.solver.CEMSolver("simulator", num_samples=8, n_steps=1, topk=2)
    world = swm.World("swm/TwoRoom-v1", 1, add_pixels=False, max_episode_steps=3)
    policy = swm.policy.MPCPolicy(solver, Named(horizon=2, receding_horizon=1))
    assert world.evaluate(policy=policy, episodes=1, seed=0, progress=False)["steps"].tolist() == [3]
