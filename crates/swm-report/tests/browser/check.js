// Measures all visible texts of a page, and returns those that are cut off or overlap another.
(async () => {
  await document.fonts.ready;
  document.querySelectorAll("details").forEach((details) => { details.open = true; });

  const faults = [];
  const say = (kind, words, detail) => {
    if (faults.length < 50) faults.push({ kind, words: words.slice(0, 80), detail });
  };
  const round = (rect) => [rect.left, rect.top, rect.right, rect.bottom].map((side) => Math.round(side));
  const page = document.scrollingElement;
  if (page.scrollWidth > innerWidth + 1) {
    say("wide page", document.title, `${page.scrollWidth} pixels in a window of ${innerWidth}`);
  }

  // Every line of every text, at the height of small letters: boxes of lines overlap where no letter does.
  const lines = [];
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const node = walker.currentNode;
    const parent = node.parentElement;
    const words = node.data.trim();
    if (!words || parent.closest("title, style, script") || !parent.checkVisibility()) continue;
    const range = document.createRange();
    range.selectNodeContents(node);
    for (const rect of range.getClientRects()) {
      if (rect.width < 1 || rect.height < 1) continue;
      const margin = 0.24 * rect.height;
      lines.push({
        node, parent, words,
        left: rect.left, right: rect.right, top: rect.top + margin, bottom: rect.bottom - margin,
      });
    }
  }

  for (const line of lines) {
    if (line.left < -1 || line.right > innerWidth + 1) say("outside the page", line.words, round(line));
    for (let box = line.parent; box && box !== document.documentElement; box = box.parentElement) {
      const style = getComputedStyle(box);
      if (style.overflowX === "visible" && style.overflowY === "visible") continue;
      if (box.tagName === "BODY" || (box instanceof SVGElement && !(box instanceof SVGSVGElement))) continue;
      const edge = box.getBoundingClientRect();
      const isInside = line.left >= edge.left - 1 && line.right <= edge.right + 1 &&
        line.top >= edge.top - 1 && line.bottom <= edge.bottom + 1;
      if (!isInside) say("cut off", line.words, { text: round(line), box: box.tagName + "." + box.getAttribute("class"), edge: round(edge) });
    }
  }

  lines.sort((a, b) => a.top - b.top);
  lines.forEach((a, i) => {
    for (let j = i + 1; j < lines.length && lines[j].top < a.bottom - 1; j += 1) {
      const b = lines[j];
      if (a.node !== b.node && a.left < b.right - 1 && b.left < a.right - 1) {
        say("overlap", a.words, { text: round(a), other: b.words.slice(0, 80), at: round(b) });
      }
    }
  });
  return { lines: lines.length, dark: matchMedia("(prefers-color-scheme: dark)").matches, width: innerWidth, faults };
})();
