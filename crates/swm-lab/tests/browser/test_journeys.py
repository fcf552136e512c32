"""Journeys through the lab in Chromium: `make test-browser` runs them.

`SWM_SCREENSHOTS` names a folder for the screenshots of the documentation.
"""

import json
import re

import pytest
from conftest import screenshot, wait_until
from playwright.sync_api import expect


def value(page, name):
    """The value of a live environment that the page shows under a name."""
    text = page.locator(f".readout div:has(dt:text-is('{name}')) dd").inner_text()
    return text.split(" / ")[0]


def wait_for_steps(page, steps):
    """Waits until an episode has this many steps."""
    page.wait_for_function(
        "steps => parseInt(document.querySelector('.readout dd').textContent) >= steps", arg=steps, timeout=30000
    )


def test_a_factor_is_varied_and_its_command_writes_the_still(lab, open_page):
    page = open_page("#envs?env=swm/PushT-v1&seed=3")
    command = page.get_by_test_id("command")
    expect(command).to_have_text("swm frame swm/PushT-v1 --seed 3 --output frame.png")
    page.get_by_role("radiogroup", name="block.shape").get_by_role("radio", name="5").click()
    page.get_by_label("agent.color", exact=True).locator("input").fill("#e0452b")
    expect(command).to_have_text(re.compile(r"--pin agent\.color=224,69,43 block\.shape=5 --output"))
    assert "pin=" in page.url, "the address has the state of the page"
    page.get_by_role("button", name="Copy").click()
    copied = page.evaluate("navigator.clipboard.readText()")
    lab.swm(*copied.split()[1:])
    still = page.request.get(lab.url + page.get_by_test_id("still").get_attribute("href")).body()
    assert (lab.home / "frame.png").read_bytes() == still
    page.get_by_role("button", name="Python").click()
    assert 'gymnasium.make("swm/PushT-v1")' in page.evaluate("navigator.clipboard.readText()")
    page.get_by_role("button", name="Play").click()
    wait_for_steps(page, 15)
    screenshot(page, "environments")
    page.get_by_role("button", name="Compare").click()
    expect(page.get_by_alt_text(re.compile("First frame with"))).to_be_visible()
    page.get_by_role("button", name="Goal", exact=True).click()
    expect(page.get_by_role("button", name="Stop comparing")).to_have_text("goal ×")
    page.get_by_role("button", name="Stop comparing").click()
    expect(page.get_by_alt_text(re.compile("First frame with"))).to_have_count(0)
    # Another page with the same address shows the same.
    again = open_page(page.url.split("/")[-1])
    expect(again.get_by_test_id("command")).to_have_text(copied)


def test_factors_are_sampled_and_reset(open_page):
    page = open_page("#envs?env=swm/TwoRoom-v1")
    command = page.get_by_test_id("command")
    page.get_by_role("button", name="Randomise").click()
    expect(command).to_have_text("swm frame swm/TwoRoom-v1 --seed 1 --variation all --output frame.png")
    page.get_by_role("button", name="Defaults").click()
    expect(command).to_have_text("swm frame swm/TwoRoom-v1 --seed 1 --output frame.png")
    page.get_by_label("agent.speed, value").fill("9")
    page.keyboard.press("Enter")
    expect(command).to_have_text(re.compile(r"--pin agent\.speed=9 --output"))
    # A value that its space does not have is corrected to the bound.
    page.get_by_label("agent.speed, value").fill("1e9")
    page.keyboard.press("Enter")
    expect(command).not_to_have_text(re.compile(r"agent\.speed=9 "))
    expect(page.get_by_role("alert")).to_have_count(0)


def test_push_t_is_driven_by_the_mouse(open_page):
    page = open_page("#envs?env=swm/PushT-v1&seed=1&fps=60")
    page.wait_for_function("() => (document.querySelector('.readout .state dd')?.textContent ?? '–') !== '–'")
    box = page.locator("canvas").bounding_box()
    to = (box["x"] + 0.7 * box["width"], box["y"] + 0.2 * box["height"])
    page.mouse.move(*to)
    page.mouse.down()
    page.mouse.move(to[0] + 1, to[1])
    page.wait_for_function(
        """() => {
            const [x, y] = document.querySelector('.readout .state dd').textContent.split(' ').map(Number);
            return Math.abs(x - 0.7 * 512) < 40 && Math.abs(y - 0.2 * 512) < 40;
        }"""
    )
    page.mouse.up()
    expect(page.get_by_label("driver")).to_have_value("hand")


def test_demonstrations_are_recorded_and_shown(lab, open_page):
    page = open_page("#envs?env=swm/TwoRoom-v1&fps=60&image=96&variation=none&pin=agent.position=40,60")
    page.get_by_label("Name of the dataset").fill("demos")
    page.get_by_role("button", name="Record").click()
    expect(page.get_by_role("status")).to_contain_text("0 episodes kept")
    page.locator("canvas").click()
    for episode in range(2):
        page.keyboard.down("ArrowDown")
        wait_for_steps(page, 8)
        page.keyboard.up("ArrowDown")
        page.keyboard.press(" ")
        page.wait_for_function("() => parseFloat(document.querySelector('.readout .state dd').textContent.split(' ')[1]) > 60")
        page.keyboard.press("k")
        expect(page.get_by_role("status")).to_contain_text(f"{episode + 1} episodes kept")
        page.keyboard.press("r")
        page.wait_for_function("() => parseInt(document.querySelector('.readout dd').textContent) === 0")
    screenshot(page, "recording")
    page.get_by_role("button", name="Finish").click()
    expect(page.get_by_role("button", name="Record")).to_be_visible()
    page.get_by_role("link", name="Data").click()
    page.get_by_role("button", name=re.compile("demos.lance")).click()
    expect(page.get_by_text("2 of 2 episodes")).to_be_visible()
    # The dataset is one as any other: the doctor finds nothing wrong.
    assert json.loads(lab.swm("inspect", "demos", "--json"))["episodes"] == 2
    lab.swm("doctor", "demos")


def test_ten_demonstrations_of_push_t_train_a_model_whose_curve_is_shown(lab, open_page):
    page = open_page("#envs?env=swm/PushT-v1&fps=120&image=64&by=expert")
    page.get_by_label("Name of the dataset").fill("ten")
    page.get_by_role("button", name="Record").click()
    for episode in range(10):
        page.get_by_role("button", name="Play").click()
        expect(page.get_by_role("status")).to_contain_text("rows wait", timeout=30000)
        page.get_by_role("button", name="Keep").click()
        expect(page.get_by_role("status")).to_contain_text(f"{episode + 1} episodes kept")
        page.get_by_role("button", name="Next").click()
        page.wait_for_function("() => parseInt(document.querySelector('.readout dd').textContent) === 0")
    page.get_by_role("button", name="Finish").click()
    expect(page.get_by_role("button", name="Record")).to_be_visible()
    settings = ["schedule.steps=20", "log_every=2", "data.batch_size=16"]
    lab.swm("train", "gcbc", "--preset", "tiny", "--data", "ten", "-o", "cloned", *settings)
    page.get_by_role("link", name="Runs").click()
    page.get_by_label(re.compile("cloned")).check()
    expect(page.get_by_label("Chart of loss")).to_be_visible()


def test_episodes_are_filtered_and_scrubbed(open_page):
    page = open_page("#data")
    page.get_by_role("button", name=re.compile("rooms.lance")).click()
    expect(page.get_by_text("120 of 120 episodes")).to_be_visible()
    rows = page.locator(".table .all .row")
    assert rows.count() < 60, "rows out of view are not in the document"
    page.get_by_role("columnheader", name="length").get_by_role("button").click()
    lengths = [int(row.inner_text().split()[1]) for row in rows.all()]
    assert lengths == sorted(lengths)
    page.get_by_label("length, min").fill("20")
    page.keyboard.press("Enter")
    expect(page.get_by_text("120 of 120 episodes")).to_have_count(0)
    rows.first.click()
    length = int(rows.first.inner_text().split()[1])
    assert length >= 20
    image = page.locator(".episode img")
    first = image.get_attribute("src")
    expect(page.locator(".episode output")).to_have_text(f"0 / {length}")
    page.get_by_label("Row").fill("15")
    expect(page.locator(".episode output")).to_have_text(f"15 / {length}")
    wait_until(lambda: image.get_attribute("src") != first)
    page.keyboard.press("Escape")
    page.locator(".episode h2").click()
    page.keyboard.press(".")
    expect(page.locator(".episode output")).to_have_text(f"16 / {length}")
    expect(page.get_by_label("Chart of action")).to_be_visible()
    assert "row=16" in page.url


def test_columns_are_histograms_and_episodes_show_their_frames(open_page):
    page = open_page("#data?name=pushes.lance")
    page.get_by_label("first and last frames").check()
    expect(page.get_by_alt_text("Last frame of episode 3")).to_be_visible()
    wait_until(lambda: page.get_by_alt_text("Last frame of episode 3").evaluate("image => image.naturalWidth") == 64)
    page.get_by_role("button", name="Columns").click()
    expect(page.get_by_label("Histogram of state[4]")).to_be_visible()
    page.locator(".coverage select").first.select_option("action")
    expect(page.get_by_label("Coverage of action[0] and action[1]")).to_be_visible()
    screenshot(page, "coverage", full_page=True)


def test_bad_episodes_are_found_and_cut(lab, open_page):
    lab.swm("collect", "swm/TwoRoom-v1", "-o", "damaged", "--episodes", "8", "--image", "32", "--format", "folder")
    frames = sorted((lab.home / "datasets" / "damaged.folder").rglob("*.jpeg"))
    frames[3].write_bytes(frames[3].read_bytes()[:40])
    page = open_page("#data?name=damaged.folder")
    expect(page.get_by_text("8 of 8 episodes")).to_be_visible()
    page.get_by_role("button", name="Examine").click()
    expect(page.locator(".findings .problem")).not_to_have_count(0)
    page.get_by_role("button", name="Cut all with problems").click()
    expect(page.locator(".row.is-cut")).to_have_count(1)
    page.get_by_label("Name of the new dataset").fill("intact")
    screenshot(page, "cut")
    page.get_by_role("button", name="Save").click()
    expect(page.get_by_text("7 episodes are in intact.lance")).to_be_visible(timeout=30000)
    lab.swm("doctor", "intact")


def test_datasets_that_do_not_open_are_listed_with_their_fault(lab, open_page):
    (lab.home / "datasets" / "broken.lance" / "_versions").mkdir(parents=True)
    page = open_page("#data")
    page.get_by_role("button", name=re.compile("broken.lance")).click()
    expect(page.get_by_role("alert")).to_be_visible()


def test_curves_follow_a_training(lab, open_page):
    page = open_page("#runs")
    page.get_by_label(re.compile("lewm")).check()
    page.get_by_label(re.compile("pldm")).check()
    expect(page.get_by_label("Chart of loss")).to_be_visible()
    page.get_by_role("button", name="optimizer/lr").click()
    expect(page.get_by_label("Chart of optimizer/lr")).to_be_visible()
    page.get_by_role("button", name="optimizer/lr").click()
    screenshot(page, "runs")
    with (lab.home / "checkpoints" / "lewm" / "train.jsonl").open("a") as log:
        log.write(json.dumps({"step": 5000, "loss": 0.001, "new_metric": 1.0}) + "\n")
    expect(page.get_by_role("button", name="new_metric")).to_be_visible(timeout=15000)


def test_a_lost_lab_is_reported(browser, tmp_path):
    from conftest import Lab

    lab = Lab(tmp_path)
    page = browser.new_page()
    page.goto(lab.url)
    page.wait_for_function("() => document.querySelector('.readout .state dd')?.textContent.includes(' ')")
    lab.stop()
    expect(page.get_by_text("The lab closed the connection.")).to_be_visible()
    page.close()


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390])
def test_pages_fit_their_widths(open_page, width, theme):
    for fragment in [
        "#envs?env=swm/TwoRoom-v1&variation=all&seed=4",
        "#envs?env=swm/PushT-v1&by=hand",
        "#data?name=pushes.lance&episode=2&row=60",
        "#plans?env=swm/TwoRoom-v1&seed=3",
        "#runs?runs=0:lewm|0:pldm",
    ]:
        page = open_page(fragment, width=width, height=844, theme=theme)
        page.wait_for_selector(".readout .state dd, .episode img, .uplot")
        assert page.evaluate("document.documentElement.scrollWidth") <= width, fragment
        cut = page.evaluate(
            """() => [...document.querySelectorAll('button, label, h1, h2, summary, .chip')]
                .filter((e) => e.offsetParent && e.scrollWidth > e.clientWidth + 1 && e.clientWidth > 0)
                .map((e) => e.outerHTML.slice(0, 80))"""
        )
        assert cut == [], fragment
        unnamed = page.evaluate(
            """() => [...document.querySelectorAll('input, select, button')]
                .filter((e) => !e.labels?.length && !e.ariaLabel && !e.textContent.trim())
                .map((e) => e.outerHTML.slice(0, 80))"""
        )
        assert unnamed == [], fragment
        if fragment.startswith("#data") and width == 1280:
            screenshot(page, f"data-{theme}")
        if fragment.startswith("#envs?env=swm/TwoRoom") and theme == "dark":
            screenshot(page, f"{'phone' if width == 390 else 'two-room'}-dark")
