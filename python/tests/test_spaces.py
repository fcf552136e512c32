"""Tests of the spaces of factors of variation."""

import gymnasium
import numpy as np
import pytest

from stable_worldmodel import spaces as swm_spaces


def factors():
    return swm_spaces.Dict(
        {
            "agent": swm_spaces.Dict(
                {
                    "color": swm_spaces.RGBBox(init_value=[255, 0, 0]),
                    "x": swm_spaces.Box(0.0, 1.0, shape=(), init_value=0.25),
                }
            ),
            "shape": swm_spaces.Discrete(4, init_value=1, constrain_fn=lambda shape: shape != 2),
        }
    )


def test_sampled_values_satisfy_the_condition_and_reset_restores_defaults():
    space = factors()
    assert space.names() == ["agent.color", "agent.x", "shape"]
    assert space.sampling_order == ["agent", "agent.color", "agent.x", "shape"]
    space.seed(0)
    seen = set()
    for _ in range(50):
        space.update(["shape"])
        seen.add(int(space.value["shape"]))
    assert seen == {0, 1, 3}
    assert space.value["agent"]["x"] == np.float32(0.25)
    space.reset()
    assert space.value["shape"] == 1


def test_changes_of_a_value_in_place_do_not_change_the_default():
    given = np.array([9, 9, 9], np.uint8)
    color = swm_spaces.RGBBox(init_value=given)
    for _ in range(2):
        color.value[:] = 7
        color.init_value[:] = 8
        given[:] = 3
        assert color.init_value.tolist() == [9, 9, 9]
        color.reset()
        assert color.value.tolist() == [9, 9, 9]
    given[:] = 5
    color.set_init_value(given)
    color.set_value(given)
    given[:] = 1
    assert color.init_value.tolist() == color.value.tolist() == [5, 5, 5]


def test_all_factors_of_a_group_are_sampled_and_values_pinned():
    space = factors()
    space.seed(1)
    swm_spaces.reset_variation_space(space, 3, {"variation": ["agent"], "variation_values": {"shape": 3}})
    first = space.value
    assert first["agent"]["x"] != np.float32(0.25) and first["shape"] == 3
    swm_spaces.reset_variation_space(space, 3, {"variation": ["agent"]})
    assert space.value["agent"]["x"] == first["agent"]["x"] and space.value["shape"] == 1
    swm_spaces.reset_variation_space(space, 4, {"variation": "all"})
    assert space.check() and isinstance(space, gymnasium.spaces.Dict)


def test_colours_of_floats_up_to_one_are_fractions():
    color = swm_spaces.RGBBox(init_value=np.array([9, 9, 9], np.uint8))
    space = swm_spaces.Dict({"agent": swm_spaces.Dict({"color": color})})
    for given, expected in (
        ([1.0, 0.0, 0.5], [255, 0, 128]),
        (np.array([0, 0, 1], np.float32), [0, 0, 255]),
        ([1, 0, 0], [1, 0, 0]),
        ([255.0, 0.0, 1.0], [255, 0, 1]),
        (np.array([1, 0, 0], np.uint8), [1, 0, 0]),
    ):
        for values in ({"agent.color": given}, {"agent": {"color": given}}):
            swm_spaces.reset_variation_space(space, 0, {"variation_values": values})
            assert color.value.tolist() == expected and color.value.dtype == np.uint8
    with pytest.raises(ValueError, match="is not in"):
        swm_spaces.reset_variation_space(space, 0, {"variation_values": {"agent.color": [1.5, 0.0, 0.0]}})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: s.update(["agent.colour"]), "agent.colour"),
        (lambda s: s.set_value({"agent.x": 2.0}), "2.0"),
        (lambda s: s.set_value({"shape": 2}), "constrain_fn"),
        (lambda s: s.set_init_value({"shape": 9}), "9"),
    ],
)
def test_invalid_values_raise_errors_with_the_reason(change, words):
    with pytest.raises(ValueError, match=words):
        change(factors())


def test_condition_of_a_group_holds_after_an_update_and_is_checked():
    members = {"a": swm_spaces.Discrete(10, init_value=0), "b": swm_spaces.Discrete(10, init_value=9)}
    group = swm_spaces.Dict(members, constrain_fn=lambda v: v["a"] < v["b"])
    space = swm_spaces.Dict({"agent": swm_spaces.Dict({"legs": group}), "shape": swm_spaces.Discrete(3, init_value=0)})
    for names in (["agent"], ["agent.legs"], ["agent.legs.a"], ["agent.legs.a", "agent.legs.b", "shape"], "all"):
        for seed in range(50):
            swm_spaces.reset_variation_space(space, seed, {"variation": names})
            assert group.value["a"] < group.value["b"]
    space.set_value({"agent.legs.a": 5, "agent.legs.b": 5})
    with pytest.warns(UserWarning, match="values of agent.legs are outside"):
        assert not space.check(debug=True)
    with pytest.raises(ValueError, match="violate a constrain_fn"):
        swm_spaces.reset_variation_space(space, 0, {"variation_values": {"agent.legs.b": 0}})
    space.set_value({"agent.legs.b": 0})
    with pytest.raises(RuntimeError, match="constrain_fn of a, b did not hold"):
        space.update(["agent.legs.a"])


def test_impossible_condition_raises():
    with pytest.raises(RuntimeError, match="1000 tries"):
        swm_spaces.Box(0, 1, shape=(2,), constrain_fn=lambda x: False).sample()


def test_values_that_the_type_does_not_hold_are_refused():
    number = swm_spaces.Box(-np.inf, np.inf, (1,))
    for wrong in ([1e300], np.array([-1e300])):
        with pytest.raises(swm_spaces.OutsideError, match="is not in"):
            number.set_value(wrong)
    number.set_value([np.inf])
    assert number.value.tolist() == [np.inf]
    for wrong in ([256, 0, 0], [-1, 0, 0], [2**70, 0, 0]):
        with pytest.raises(swm_spaces.OutsideError, match="is not in"):
            swm_spaces.RGBBox().set_value(wrong)
