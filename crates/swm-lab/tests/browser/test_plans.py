"""Journeys through plans, trainings and results of the lab in Chromium: `make test-browser` runs them."""

import json
import re

import pytest
from conftest import screenshot, wait_until
from playwright.sync_api import expect


def decide(page):
    """Searches a plan, or executes one and searches the next; returns the number of steps that it took."""
    page.wait_for_function("() => document.querySelector('.readout .state dd')?.textContent !== '–'")
    planned, steps = page.locator(".tree .node circle[r='4']"), page.locator(".tree .node")
    before, first = planned.count(), steps.count()
    page.get_by_role("button", name="Decide").click()
    expect(planned).to_have_count(before + 1, timeout=30000)
    expect(page.get_by_role("button", name="Play")).to_be_visible(timeout=30000)
    return steps.count() - first


def test_a_plan_is_watched_branched_and_compared(lab, open_page):
    page = open_page("#plans?env=swm/TwoRoom-v1&seed=3&fps=60")
    command = page.get_by_test_id("command")
    expect(command).to_contain_text("swm eval simulator --env swm/TwoRoom-v1 --solver cem,")
    assert decide(page) == 0, "the first decision executes nothing"
    expect(page.get_by_label("Chart of cost")).to_be_visible()
    expect(page.locator(".fan .is-best")).to_have_count(1)
    expect(page.locator(".fan .is-elite")).to_have_count(7)
    last = page.locator(".fan .is-best polyline").last.get_attribute("points")
    page.keyboard.press("[")
    expect(page.locator(".iterations output")).to_contain_text("8 / 9")
    assert page.locator(".fan .is-best polyline").last.get_attribute("points") != last, "another iteration"
    assert decide(page) == 10
    decide(page)
    expect(page.locator(".tree .node")).to_have_count(21)
    # Back to the tenth step, and on from there with a faster agent.
    page.locator(".tree .node").nth(10).click()
    expect(page.locator(".tree .is-present")).to_have_attribute("data-node", re.compile(r"\d+"))
    expect(page.locator(".readout dd").first).to_have_text("10 / 100")
    page.locator(".changes summary").click()
    page.get_by_label("factor").select_option("agent.speed")
    page.get_by_label("agent.speed, value").fill("9")
    page.keyboard.press("Enter")
    page.get_by_role("button", name="Change the factor").click()
    expect(page.locator(".branches tbody tr")).to_have_count(2)
    decide(page)
    decide(page)
    # Another action at the fifth step.
    page.locator(".tree .node").nth(5).click()
    expect(page.locator(".readout dd").first).to_have_text("5 / 100")
    page.get_by_label("action[0], value").fill("1")
    page.keyboard.press("Enter")
    for _ in range(3):
        page.get_by_role("button", name="Take this action").click()
    expect(page.locator(".branches tbody tr")).to_have_count(3)
    decide(page)
    page.locator(".changes summary").click()
    expect(page.get_by_label("Chart of distance to the goal")).to_be_visible()
    expect(page.get_by_alt_text(re.compile("Last frame of agent.speed = 9"))).to_be_visible()
    screenshot(page, "plans", full_page=True)
    page.get_by_role("button", name="Keep this branch only").click()
    expect(page.locator(".branches tbody tr")).to_have_count(2)
    # The command evaluates the planner that the page shows.
    lab.swm(
        *command.inner_text().split()[1:],
        "--episodes",
        "2",
        "--output",
        "planned",
        "--image",
        "32",
    )
    assert json.loads((lab.home / "planned" / "results.json").read_text())["env"] == "swm/TwoRoom-v1"


def test_a_world_model_plans_and_a_step_back_shows_its_search(open_page):
    page = open_page("#plans?env=swm/TwoRoom-v1&seed=3&fps=60&model=zoo:two-room/pldm")
    expect(page.get_by_test_id("command")).to_contain_text("swm eval zoo:two-room/pldm")
    decide(page)
    cost = page.locator(".iterations output").inner_text()
    decide(page)
    page.locator(".tree .node").first.click()
    expect(page.locator(".iterations output")).to_have_text(cost)
    # A solver that needs a gradient fits this model.
    page.get_by_label("solver").select_option("gd")
    expect(page.get_by_test_id("command")).to_contain_text("--solver gd,")
    page.get_by_role("button", name="Decide").click()
    expect(page.get_by_label("Chart of spread of the candidates")).to_be_visible()
    expect(page.get_by_label("Imagined and true latents of the cheapest candidates")).to_be_visible()
    screenshot(page, "imagination", full_page=True)
    expect(page.get_by_role("alert")).to_have_count(0)


def test_what_a_model_imagines_is_decoded_into_frames(open_page):
    page = open_page("#plans?env=swm/TwoRoom-v1&seed=3&fps=60&model=zoo:two-room/pldm")
    expect(page.get_by_test_id("command")).to_contain_text("swm eval zoo:two-room/pldm")
    decide(page)
    choice = page.get_by_label("decode with")
    expect(choice.locator("option")).to_have_text(["none", "0/rooms.lance"])
    # The fit can be stopped.
    choice.select_option("0/rooms.lance")
    page.get_by_role("button", name="Stop").click()
    expect(page.get_by_label("Fit of the decoder")).to_have_count(0)
    expect(choice).to_have_value("none")
    choice.select_option("0/rooms.lance")
    # The plan that is shown gets its frames, and so does the next one.
    for row in ["environment", "its latents, decoded", "imagined, decoded"]:
        for step in range(0, 21, 5):
            expect(page.get_by_alt_text(f"{row}, step {step}", exact=True)).to_be_visible(timeout=240000)
    expect(page.get_by_alt_text("its latents, decoded, goal")).to_be_visible()
    expect(page.get_by_text(re.compile(r"\d+ % of the variance of pixels on held-out episodes"))).to_be_visible()
    start = page.get_by_alt_text("imagined, decoded, step 0", exact=True).get_attribute("src")
    assert start == page.get_by_alt_text("its latents, decoded, step 0", exact=True).get_attribute("src")
    decide(page)
    expect(page.get_by_alt_text("imagined, decoded, step 0", exact=True)).not_to_have_attribute("src", start)
    page.set_viewport_size({"width": 1400, "height": 1000})
    screenshot(page, "imagined", full_page=True)
    # A dataset that is not in the list is refused by the server, see the tests of the crate.
    choice.select_option("none")
    expect(page.locator(".decoded")).to_have_count(0)
    expect(page.get_by_role("alert")).to_have_count(0)


def test_states_without_a_place_on_the_frame_are_projected(open_page):
    page = open_page("#plans?env=swm/PendulumControl-v1&seed=1&fps=60")
    decide(page)
    expect(page.get_by_text(re.compile("PCA"))).to_be_visible()
    expect(page.locator(".fan-only .is-best")).to_have_count(1)


def test_a_small_training_is_started_and_followed(lab, open_page):
    page = open_page("#runs")
    page.get_by_text("Start a training").click()
    page.get_by_label("model").select_option("gcbc")
    page.get_by_label("preset").select_option("tiny")
    page.get_by_label("dataset").select_option(label="rooms.lance")
    page.get_by_label("steps").fill("12")
    page.get_by_label("Name of the run").fill("from-page")
    page.get_by_role("button", name="Start", exact=True).click()
    row = page.locator(".trainings li", has_text="from-page")
    expect(row).to_be_visible()
    expect(page.get_by_label("Chart of loss")).to_be_visible(timeout=120000)
    expect(row).to_contain_text("finished", timeout=120000)
    screenshot(page, "training")
    assert "gcbc" in lab.swm("checkpoints", "show", "from-page")


def test_a_training_is_stopped_and_can_be_continued(lab, open_page):
    page = open_page("#runs")
    page.get_by_text("Start a training").click()
    page.get_by_label("model").select_option("gcbc")
    page.get_by_label("dataset").select_option(label="rooms.lance")
    page.get_by_label("steps").fill("100000")
    page.get_by_label("Name of the run").fill("stopped")
    page.get_by_role("button", name="Start", exact=True).click()
    log = lab.home / "checkpoints" / "stopped" / "train.jsonl"
    wait_until(lambda: log.exists() and log.stat().st_size > 0, patience=120)
    page.get_by_role("button", name="Stop stopped").click()
    row = page.locator(".trainings li", has_text="stopped").first
    expect(row).to_contain_text("stopped", timeout=120000)
    expect(page.get_by_role("button", name="Stop stopped")).to_have_count(0, timeout=120000)


def test_episodes_are_collected_and_a_planner_is_evaluated(lab, open_page):
    page = open_page("#envs?env=swm/TwoRoom-v1&seed=5&pin=agent.speed%3D9")
    page.get_by_text("Collect episodes").click()
    page.get_by_label("policy", exact=True).select_option("random")
    page.get_by_label("episodes", exact=True).fill("7")
    page.get_by_label("Name of what is written").fill("fast")
    page.get_by_role("button", name="Start", exact=True).click()
    page.get_by_role("link", name="Runs", exact=True).last.click()
    row = page.locator(".trainings li", has_text="fast")
    expect(row).to_contain_text("collection, finished", timeout=120000)
    found = json.loads(lab.swm("inspect", "fast", "--json"))
    assert found["episodes"] == 7
    assert "9" in str(found["manifest"]["config"])
    # The planner of the page plays from the states of that dataset.
    page = open_page("#plans?env=swm/TwoRoom-v1&seed=3&model=zoo:two-room/pldm&set=samples%3D64,iterations%3D4")
    expect(page.get_by_test_id("command")).to_contain_text("swm eval zoo:two-room/pldm")
    page.get_by_text("Evaluate this planner").click()
    page.get_by_label("starts").select_option("0/fast.lance")
    page.get_by_label("episodes", exact=True).fill("3")
    page.get_by_label("Name of what is written").fill("from-plans")
    page.get_by_role("button", name="Start", exact=True).click()
    page.get_by_role("link", name="Runs", exact=True).last.click()
    row = page.locator(".trainings li", has_text="from-plans")
    expect(row).to_contain_text("evaluation, finished", timeout=120000)
    screenshot(page, "processes")
    results = json.loads((lab.home / "results" / "from-plans" / "results.json").read_text())
    assert len(results["runs"][0]["episodes"]) == 3
    page.goto(lab.url + "#results")
    expect(page.get_by_role("button", name=re.compile("from-plans"))).to_be_visible(timeout=30000)


def test_results_are_shown_in_a_frame_of_their_own(lab, open_page):
    lab.swm(
        "eval",
        "random",
        "--env",
        "swm/TwoRoom-v1",
        "--episodes",
        "4",
        "--output",
        "results/random",
        "--image",
        "32",
    )
    page = open_page("#results")
    page.get_by_role("button", name="results/random").click()
    frame = page.frame_locator("iframe")
    expect(frame.get_by_role("heading", level=1)).to_contain_text("TwoRoom")
    screenshot(page, "results")
    # The frame has another origin, and reaches nothing of the lab.
    assert page.frames[1].evaluate("window.origin") == "null"


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390])
def test_plans_fit_their_width(open_page, width, theme):
    page = open_page("#plans?env=swm/PushT-v1&seed=3&fps=60", width=width, height=844, theme=theme)
    decide(page)
    decide(page)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    if width == 390 and theme == "dark":
        screenshot(page, "plans-phone")
    if width == 1280 and theme == "dark":
        screenshot(page, "plans-dark")
