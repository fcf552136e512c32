"""Live environments in Chromium: views, wrappers, two settings side by side, gamepads."""

import re

import pytest
from conftest import screenshot, wait_until
from playwright.sync_api import expect
from test_journeys import value, wait_for_steps


def steps(page):
    """The steps of both sides, as the page shows them."""
    return [int(text.split(" / ")[0]) for text in page.locator(".readout div:first-child dd").all_inner_texts()]


def compare_with_the_command(lab, page):
    """Runs the command of the page: its frame is the still of the page, byte for byte."""
    lab.swm(*page.get_by_test_id("command").inner_text().split()[1:])
    still = page.request.get(lab.url + page.get_by_test_id("still").get_attribute("href")).body()
    assert (lab.home / "frame.png").read_bytes() == still


def test_wrappers_are_stacked_dragged_and_in_the_command(lab, open_page):
    page = open_page("#envs?env=swm/PushT-v1&seed=3")
    command = page.get_by_test_id("command")
    expect(command).to_have_text(re.compile("--seed 3"))
    page.locator(".wrappers summary").click()
    for name in ["noise", "cutout", "blur"]:
        page.get_by_label("Add a wrapper").select_option(name)
        expect(page.get_by_role("button", name=f"Remove {name}")).to_be_visible()
    page.get_by_label("noise std").fill("20")
    page.keyboard.press("Enter")
    expect(command).to_contain_text("--wrapper noise,std=20 --wrapper cutout --wrapper blur")
    compare_with_the_command(lab, page)
    # The order is changed with the keyboard, and with the mouse.
    page.get_by_role("button", name="Move noise down").press("Enter")
    expect(command).to_contain_text("--wrapper cutout --wrapper noise,std=20 --wrapper blur")
    page.locator(".wrappers .handle").nth(2).drag_to(page.locator(".wrappers li").nth(0))
    expect(command).to_contain_text("--wrapper blur --wrapper cutout --wrapper noise,std=20")
    compare_with_the_command(lab, page)
    screenshot(page, "wrappers", full_page=True)
    page.get_by_label("the goal, too").check()
    expect(command).to_contain_text("--wrap-goal")
    for name in ["blur", "cutout", "noise"]:
        page.get_by_role("button", name=f"Remove {name}").click()
    expect(command).to_have_text("swm frame swm/PushT-v1 --seed 3 --output frame.png")
    # What the wrapper refuses is said, and the frame stays.
    page.get_by_label("Add a wrapper").select_option("blur")
    page.get_by_label("blur kernel").fill("1000")
    page.keyboard.press("Enter")
    expect(page.get_by_role("alert")).to_contain_text("kernel")


def test_cameras_show_depth_and_segmentation(lab, open_page):
    page = open_page("#envs?env=swm/HumanoidDMControl-v0&seed=1")
    command = page.get_by_test_id("command")
    expect(command).to_contain_text("--seed 1", timeout=60000)
    page.get_by_label("shows").select_option("depth")
    expect(command).to_contain_text("--view depth", timeout=60000)
    compare_with_the_command(lab, page)
    page.get_by_label("camera").select_option(index=1)
    page.get_by_label("shows").select_option("segmentation")
    expect(command).to_contain_text(":segmentation", timeout=60000)
    compare_with_the_command(lab, page)
    screenshot(page, "segmentation")
    expect(page.get_by_label("Add a wrapper")).to_be_disabled()
    expect(page.get_by_role("alert")).to_have_count(0)


def test_two_settings_step_together(open_page):
    page = open_page("#envs?env=swm/PushT-v1&seed=3&fps=60", width=1400)
    page.get_by_role("button", name="Side by side").click()
    expect(page.get_by_label(re.compile("right frame"))).to_be_visible()
    page.get_by_role("radiogroup", name="block.shape").get_by_role("radio", name="5").click()
    expect(page.get_by_label("Difference")).to_contain_text("block.shape: 2 | 5")
    expect(page.get_by_test_id("command")).to_contain_text("block.shape=5")
    page.get_by_role("radiogroup", name="Whose settings").get_by_role("radio", name="left").click()
    expect(page.get_by_test_id("command")).not_to_contain_text("block.shape")
    page.get_by_role("button", name="Play").click()
    wait_for_steps(page, 12)
    page.get_by_role("button", name="Pause").click()
    # Both come to rest at the same step.
    wait_until(lambda: len(set(steps(page))) == 1 and steps(page)[0] >= 12)
    page.get_by_role("button", name="Step", exact=True).click()
    wait_until(lambda: len(set(steps(page))) == 1)
    screenshot(page, "side-by-side")
    page.get_by_role("button", name="Side by side").click()
    expect(page.get_by_label(re.compile("right frame"))).to_have_count(0)


PAD = """() => {
    window.pad = {connected: true, axes: [0, 0, 0, 0], buttons: Array.from({length: 17}, () => ({pressed: false}))};
    Object.defineProperty(navigator, 'getGamepads', {value: () => [null, window.pad]});
}"""


@pytest.mark.parametrize(
    ("env", "held", "action"),
    [
        # Half a tilt is half of the bound, a little one is none, the cross is the bound.
        ("swm/TwoRoom-v1", "axes[0] = 0.5", ["0.5", "0"]),
        ("swm/TwoRoom-v1", "axes[1] = 0.1", ["0", "0"]),
        ("swm/TwoRoom-v1", "buttons[12].pressed = true", ["0", "-1"]),
        # Of discrete actions, the last one.
        ("swm/AcrobotControl-v1", "axes[0] = 0.8", ["2"]),
    ],
)
def test_a_gamepad_drives(open_page, env, held, action):
    page = open_page(f"#envs?env={env}&by=hand&fps=60")
    expect(page.get_by_test_id("command")).to_contain_text(env)
    page.evaluate(PAD)
    page.evaluate(f"window.pad.{held}")
    sliders = [page.get_by_label(f"action[{i}], value") for i in range(len(action))]
    for slider, element in zip(sliders, action, strict=True):
        expect(slider).to_have_value(element)
    if any(float(element) for element in action):
        wait_until(lambda: int(value(page, "step")) > 2)
    page.evaluate("window.pad.axes = [0, 0, 0, 0]; window.pad.buttons[12].pressed = false")
    expect(sliders[0]).to_have_value("0")
