// A search: its costs over the iterations, what the candidates cost, and what the cheapest lead to.

import { useMemo } from "preact/hooks";
import type uPlot from "uplot";
import { Chart } from "./chart";
import { short } from "./format";
import { ImaginationPanel } from "./plan-imagination";
import { Fan } from "./plan-stage";
import type { Search } from "./plan-session";

const WIDTH = 320;
const HEIGHT = 120;
const EDGE = 6;

interface Props {
  search?: Search;
  // The index of the iteration that is shown.
  iteration: number;
  onIteration: (index: number) => void;
}

export function SearchPanel({ search, iteration, onIteration }: Props) {
  const data = useMemo(() => {
    if (!search) return undefined;
    const xs = search.best.map((_, i) => i);
    const elites = search.iterations.some((iteration) => iteration.elites > 0) ? [search.elites] : [];
    return {
      costs: [xs, search.best, ...elites, search.mean] as uPlot.AlignedData,
      spread: [xs, search.spread] as uPlot.AlignedData,
    };
  }, [search]);
  if (!search || !data) {
    return (
      <section class="search" aria-label="Search">
        <p class="loading">No search is shown. Decide (d) searches a plan.</p>
      </section>
    );
  }
  const hasElites = search.iterations.some(({ elites }) => elites > 0);
  return (
    <section class="search" aria-label="Search">
      <div class="bar">
        <h2>Search</h2>
        <small>
          {search.best.length} iterations in {short(search.seconds)} s, {search.iterations[0]?.samples} candidates each
        </small>
      </div>
      <Chart
        title="cost"
        data={data.costs}
        labels={hasElites ? ["best", "elites", "mean"] : ["best", "mean"]}
        xLabel="iteration"
        height={170}
        sync="search"
        mark={iteration}
        onPick={onIteration}
      />
      <Costs search={search} iteration={iteration} onIteration={onIteration} />
      <Chart
        title={hasElites ? "spread of the elites" : "spread of the candidates"}
        data={data.spread}
        labels={["spread"]}
        xLabel="iteration"
        height={130}
        sync="search"
        mark={iteration}
        onPick={onIteration}
      />
      <Ends search={search} iteration={iteration} />
      {search.imagination && <ImaginationPanel imagination={search.imagination} />}
      {search.explained !== null && (
        <figure class="fan-only">
          <Fan search={search} iteration={iteration} />
          <figcaption>
            States of the candidates, along the two directions in which they differ most (PCA,{" "}
            {Math.round(100 * search.explained)} % of the variance)
          </figcaption>
        </figure>
      )}
    </section>
  );
}

// Every candidate's cost in every iteration, or some of them: a point each.
function Costs({ search, iteration, onIteration }: { search: Search; iteration: number; onIteration: (index: number) => void }) {
  const all = search.iterations.flatMap(({ costs }) => costs);
  const low = Math.min(...all);
  const high = Math.max(...all);
  const last = Math.max(1, search.best.length - 1);
  const x = (index: number) => EDGE + (index / last) * (WIDTH - 2 * EDGE);
  const y = (cost: number) => EDGE + (1 - (cost - low) / (high - low || 1)) * (HEIGHT - 2 * EDGE);
  return (
    <figure class="costs">
      <svg viewBox={`0 0 ${WIDTH} ${HEIGHT}`} role="img" aria-label="Costs of the candidates of every iteration">
        {search.iterations.map(({ index, costs, elites, samples }) => (
          <g key={index} class={index === iteration ? "is-chosen" : ""} onClick={() => onIteration(index)}>
            <title>{`iteration ${index}: ${short(costs[0])} to ${short(costs[costs.length - 1])}`}</title>
            <rect class="hit" x={x(index) - EDGE} y={0} width={2 * EDGE} height={HEIGHT} />
            {costs.map((cost, i) => (
              <circle
                key={i}
                cx={x(index)}
                cy={y(cost)}
                r={1.6}
                class={(i * (samples - 1)) / Math.max(1, costs.length - 1) < elites ? "is-elite" : ""}
              />
            ))}
          </g>
        ))}
      </svg>
      <figcaption>
        costs of the candidates, {short(low)} to {short(high)}
        {search.iterations.some(({ elites }) => elites > 0) ? "; elites in colour" : ""}
      </figcaption>
    </figure>
  );
}

// The last frames of the cheapest candidates, of the nearest iteration that has some.
function Ends({ search, iteration }: { search: Search; iteration: number }) {
  const of = nearest(
    search.ends.map((end) => end.iteration),
    iteration,
  );
  const shown = search.ends.filter((end) => end.iteration === of);
  if (shown.length === 0) return null;
  return (
    <figure class="ends">
      <div>
        {shown.map((end) => (
          <span key={end.rank}>
            <img src={`data:image/jpeg;base64,${end.jpeg}`} alt={`Last frame of candidate ${end.rank + 1} of iteration ${of}`} />
            <small>{short(end.cost)}</small>
          </span>
        ))}
      </div>
      <figcaption>where the cheapest candidates of iteration {of} end, with their costs</figcaption>
    </figure>
  );
}

// The largest index of those given that is at most the wanted one, else the smallest.
export function nearest(given: number[], wanted: number): number {
  const below = given.filter((index) => index <= wanted);
  return below.length > 0 ? Math.max(...below) : Math.min(...given);
}
