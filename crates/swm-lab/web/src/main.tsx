import { render } from "preact";
import { useEffect, useRef } from "preact/hooks";
import { BenchPage } from "./bench";
import { DataPage } from "./data";
import { EnvPage } from "./env";
import { PlansPage } from "./plans";
import { ReportsPage } from "./reports";
import { RunsPage } from "./runs";
import { useKeys, usePlace, useTheme } from "./state";
import "uplot/dist/uPlot.min.css";
import "./style.css";
import "./pages.css";
import "./plans.css";
import "./wrappers.css";

const PAGES = [
  { id: "envs", name: "Environments", Page: EnvPage },
  { id: "data", name: "Data", Page: DataPage },
  { id: "plans", name: "Plans", Page: PlansPage },
  { id: "runs", name: "Runs", Page: RunsPage },
  { id: "results", name: "Results", Page: ReportsPage },
];

// No link leads to it.
const HIDDEN = [{ id: "bench", name: "Bench", Page: BenchPage }];

const SHORTCUTS = [
  ["1 … 5", "environments, data, plans, runs, results"],
  ["?", "this list"],
  ["Space", "play or pause"],
  [".", "one step (environments, plans), next row (data)"],
  [",", "previous row (data), back one step (plans)"],
  ["d", "execute the plan and search the next one (plans)"],
  ["[ ]", "previous and next iteration of the search (plans)"],
  ["r", "reset with the same seed"],
  ["n", "reset with the next seed"],
  ["v", "sample all factors, with the next seed"],
  ["c", "copy the command"],
  ["arrows", "drive an environment; move in a table"],
  ["x", "cut the chosen episode"],
  ["k d", "keep or discard the recorded episode"],
];

function App() {
  const { page, params } = usePlace();
  const [theme, nextTheme] = useTheme();
  const help = useRef<HTMLDialogElement>(null);
  const found = [...PAGES, ...HIDDEN].find(({ id }) => id === page) ?? PAGES[0];
  const go = (index: number) => () => {
    location.hash = `#${PAGES[index].id}`;
  };
  useKeys({ "1": go(0), "2": go(1), "3": go(2), "4": go(3), "5": go(4), "?": () => help.current?.showModal() });
  useEffect(() => {
    document.title = `${found.name} · swm lab`;
  }, [found]);
  return (
    <>
      <header class="top">
        <span class="brand">
          swm <b>lab</b>
        </span>
        <nav aria-label="Pages">
          {PAGES.map(({ id, name }) => (
            <a href={`#${id}`} key={id} aria-current={found.id === id ? "page" : undefined}>
              {name}
            </a>
          ))}
        </nav>
        <span class="grow" />
        <button type="button" class="quiet" onClick={nextTheme} aria-label={`Theme: ${theme}`} title="Theme">
          {theme}
        </button>
        <button type="button" class="quiet" onClick={() => help.current?.showModal()} aria-label="Keyboard shortcuts">
          ?
        </button>
      </header>
      <main id="main">
        <found.Page params={params} />
      </main>
      <dialog ref={help} aria-label="Keyboard shortcuts">
        <h2>Keyboard shortcuts</h2>
        <dl class="keys">
          {SHORTCUTS.map(([keys, does]) => (
            <div key={keys}>
              <dt>
                {keys.split(" ").map((key) => (
                  <kbd key={key}>{key}</kbd>
                ))}
              </dt>
              <dd>{does}</dd>
            </div>
          ))}
        </dl>
        <div class="bar">
          <button type="button" onClick={() => help.current?.close()}>
            Close
          </button>
          <span class="grow" />
          <a href="licences.txt" target="_blank" rel="noreferrer">
            <small>Licences</small>
          </a>
        </div>
      </dialog>
    </>
  );
}

const root = document.getElementById("app");
if (root) render(<App />, root);
