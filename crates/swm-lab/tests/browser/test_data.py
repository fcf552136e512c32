"""Datasets and leaderboards in Chromium: columns as filters, episodes side by side, videos, pages of a leaderboard."""

import re
from pathlib import Path

from conftest import screenshot
from playwright.sync_api import expect


def test_episodes_are_filtered_by_a_column(open_page):
    page = open_page("#data?name=pushes.lance", width=1400)
    expect(page.get_by_text("6 of 6 episodes")).to_be_visible()
    page.get_by_label("Column", exact=True).select_option("state")
    page.get_by_label("Element", exact=True).select_option("1")
    page.get_by_label("Statistic").select_option("max")
    rows = page.locator(".table .all .row")
    heading = page.get_by_role("columnheader", name="max state[1]")
    heading.get_by_role("button").click()
    expect(heading).to_have_attribute("aria-sort", "ascending")
    values = [float(row.locator("[role=cell]").nth(4).inner_text()) for row in rows.all()]
    assert values == sorted(values)
    page.get_by_label("max state[1], min").fill(str(values[3]))
    page.keyboard.press("Enter")
    expect(page.get_by_text(re.compile("[23] of 6 episodes"))).to_be_visible()
    screenshot(page, "column-filter")
    # A factor has one value in an episode, and another dataset has no such column.
    page.get_by_label("Column", exact=True).select_option("variation.agent.start_position")
    expect(page.get_by_label("Statistic")).to_have_count(0)
    expect(page.get_by_text("6 of 6 episodes")).to_be_visible()
    page.get_by_role("button", name=re.compile("rooms.lance")).click()
    expect(page.get_by_text("120 of 120 episodes")).to_be_visible()


def test_two_episodes_are_scrubbed_together_and_one_is_a_video(lab, open_page):
    page = open_page("#data?name=rooms.lance&episode=3", width=1400)
    page.get_by_role("button", name="Keep beside").click()
    page.locator(".table .all .row").nth(5).click()
    expect(page.get_by_role("heading", name=re.compile("Episode 5 .* beside episode 3"))).to_be_visible()
    frames = page.locator(".episode .frame img")
    expect(frames).to_have_count(2)
    page.get_by_label("Row").fill("4")
    for frame in frames.all():
        expect(frame).to_have_attribute("alt", "Row 4 of pixels")
    # The shorter episode rests at its last row.
    page.get_by_label("Row").fill("1000")
    shown = [int(frame.get_attribute("alt").split()[1]) for frame in frames.all()]
    lengths = [int(row.inner_text().split()[1]) for row in page.locator(".table .all .row").all()[:6]]
    expect(frames.nth(0)).to_have_attribute("alt", f"Row {lengths[5]} of pixels")
    expect(frames.nth(1)).to_have_attribute("alt", f"Row {lengths[3]} of pixels")
    assert len(shown) == 2
    expect(page.get_by_label("Chart of action")).to_have_count(2)
    page.get_by_label("Row").fill("6")
    screenshot(page, "episodes")
    with page.expect_download() as download:
        page.get_by_role("link", name="MP4").click()
    path = lab.home / "episode.mp4"
    download.value.save_as(path)
    assert download.value.suggested_filename == "episode_5.mp4"
    assert path.read_bytes()[4:8] == b"ftyp"
    page.get_by_role("button", name="Not beside").click()
    expect(frames).to_have_count(1)


def test_episodes_of_two_datasets_are_scrubbed_together(open_page):
    page = open_page("#data?name=rooms.lance&episode=3", width=1400)
    page.get_by_role("button", name="Keep beside").click()
    page.get_by_role("button", name=re.compile("pushes.lance")).click()
    page.locator(".table .all .row").nth(1).click()
    heading = page.get_by_role("heading", name=re.compile("Episode 1 .* beside episode 3 of rooms.lance"))
    expect(heading).to_be_visible()
    frames = page.locator(".episode .frame img")
    expect(frames).to_have_count(2)
    # The columns that both datasets have.
    expect(page.get_by_label("Chart of action")).to_have_count(2)
    page.get_by_label("Row").fill("4")
    for frame in frames.all():
        expect(frame).to_have_attribute("alt", "Row 4 of pixels")
    columns = page.get_by_role("group", name="Columns")
    expect(columns.get_by_role("button", name="state", exact=True)).to_be_visible()
    expect(columns.get_by_role("button", name="block_pose")).to_have_count(0)
    page.reload()
    expect(heading).to_be_visible()
    page.get_by_role("button", name="Not beside").click()
    expect(frames).to_have_count(1)


def test_a_leaderboard_is_shown(lab, open_page):
    entries = Path(__file__).parents[4] / "leaderboard"
    lab.swm("leaderboard", "build", str(entries), "--output", "board")
    page = open_page("#results")
    page.get_by_role("button", name=re.compile("board leaderboard")).click()
    shown = page.frame_locator("iframe")
    expect(shown.get_by_role("heading", name="Leaderboard")).to_be_visible()
    screenshot(page, "leaderboard")
    page.get_by_label("Page", exact=True).select_option(index=1)
    expect(shown.get_by_text(re.compile("swm leaderboard verify")).first).to_be_visible()
    assert "entry=" in page.url
