// The steps that were played, as a tree: every step can be gone back to, and branches can be compared.

import { useEffect, useMemo } from "preact/hooks";
import uPlot from "uplot";
import { Chart, COLOURS } from "./chart";
import { bytes, short } from "./format";
import { type Branch, type Node, type Plans } from "./plan-session";
import { patch } from "./state";

const STEP = 11;
const LANE = 18;
const EDGE = 10;

interface Props {
  plans: Plans;
  all: Branch[];
  compared: Set<number>;
}

export function Tree({ plans, all, compared }: Props) {
  const { header, nodes, bounds, send } = plans;
  const first = Math.min(...all.map((branch) => branch.nodes[0].step), 0);
  const last = Math.max(...all.map((branch) => branch.tip.step), 1);
  const lanes = new Map(all.map((branch, lane) => [branch.id, lane]));
  const x = (node: Node) => EDGE + (node.step - first) * STEP;
  const y = (node: Node) => EDGE + (lanes.get(node.branch) ?? 0) * LANE;
  const [width, height] = [2 * EDGE + (last - first) * STEP, 2 * EDGE + (all.length - 1) * LANE];
  const colour = (node: Node) => COLOURS[node.branch % COLOURS.length];
  return (
    <section class="tree panel" aria-label="Tree of steps">
      <div class="bar">
        <h2>Steps</h2>
        <small>
          {nodes.size} of {bounds?.most_nodes ?? "–"}, {bytes(bounds?.bytes ?? 0)} of {bytes(bounds?.most_bytes ?? 0)}
        </small>
        <span class="grow" />
        <button type="button" onClick={() => send("forget")} disabled={all.length < 2} title="Forget the other branches">
          Keep this branch only
        </button>
      </div>
      <div class="scroll">
        <svg width={width} height={height} role="group" aria-label="Steps">
          {[...nodes.values()].map((node) => {
            const parent = nodes.get(node.parent ?? -1);
            if (!parent) return null;
            const bend = parent.branch === node.branch ? "" : `L${x(parent)},${y(node)}`;
            return <path key={node.id} d={`M${x(parent)},${y(parent)}${bend}L${x(node)},${y(node)}`} stroke={colour(node)} />;
          })}
          {[...nodes.values()].map((node) => (
            <g
              key={node.id}
              class={`node ${node.id === header?.node ? "is-present" : ""}`}
              data-node={node.id}
              onClick={() => send("go", { node: node.id })}
            >
              <title>{describe(node)}</title>
              <rect class="hit" x={x(node) - STEP / 2} y={y(node) - LANE / 2} width={STEP} height={LANE} />
              {node.change !== null && <circle class="ring" cx={x(node)} cy={y(node)} r={6} stroke={colour(node)} />}
              <circle cx={x(node)} cy={y(node)} r={node.cost === null ? 2 : 4} fill={colour(node)} />
              {node.success && <circle class="goal" cx={x(node)} cy={y(node)} r={2} />}
            </g>
          ))}
        </svg>
      </div>
      <Branches plans={plans} all={all} compared={compared} />
    </section>
  );
}

function describe(node: Node): string {
  const parts = [`step ${node.step}`, `distance ${short(node.distance)}`];
  if (node.change !== null) parts.push(node.change);
  if (node.cost !== null) parts.push(`planned, cost ${short(node.cost)}`);
  if (node.success) parts.push("goal reached");
  return parts.join(", ");
}

function Branches({ plans, all, compared }: Props) {
  const { nodes, header, send } = plans;
  const present = nodes.get(header?.node ?? -1)?.branch;
  const toggle = (id: number) => {
    const next = new Set(compared);
    if (!next.delete(id)) next.add(id);
    // None is a choice as well.
    patch({ compare: [...next].sort((a, b) => a - b).join(",") || "none" });
  };
  return (
    <table class="branches">
      <thead>
        <tr>
          <th scope="col">branch</th>
          <th scope="col">steps</th>
          <th scope="col">distance</th>
          <th scope="col">return</th>
          <th scope="col">goal</th>
          <th scope="col">
            <span class="wide">compare</span>
          </th>
        </tr>
      </thead>
      <tbody>
        {all.map((branch) => (
          <tr key={branch.id} class={branch.id === present ? "is-chosen" : ""}>
            <th scope="row">
              <button type="button" class="quiet" onClick={() => send("go", { node: branch.tip.id })} title="Go to its last step">
                <svg width="10" height="10" aria-hidden="true">
                  <rect width="10" height="10" rx="2" fill={COLOURS[branch.id % COLOURS.length]} />
                </svg>{" "}
                {branch.change}
              </button>
            </th>
            <td>
              {branch.nodes[0].step}–{branch.tip.step}
            </td>
            <td>{short(branch.tip.distance)}</td>
            <td>{short(branch.tip.total)}</td>
            <td class={branch.tip.success ? "success-yes" : "success-no"}>{branch.tip.success ? "reached" : "–"}</td>
            <td>
              <input
                type="checkbox"
                aria-label={`Compare ${branch.change}`}
                checked={compared.has(branch.id)}
                onChange={() => toggle(branch.id)}
              />
            </td>
          </tr>
        ))}
      </tbody>
    </table>
  );
}

// The distance to the goal over the steps of branches, and their last frames side by side.
export function Comparison({ plans, chosen }: { plans: Plans; chosen: Branch[] }) {
  const { nodes, peeked, send } = plans;
  const tips = chosen.map((branch) => branch.tip.id).join(",");
  const [data, labels] = useMemo(() => {
    const series = chosen.map((branch) => {
      const before = nodes.get(branch.nodes[0].parent ?? -1);
      const all = before ? [before, ...branch.nodes] : branch.nodes;
      // A changed factor adds a step with the same number.
      const last = new Map(all.map((node) => [node.step, node.distance]));
      return [[...last.keys()], [...last.values()]] as uPlot.AlignedData;
    });
    return [uPlot.join(series), chosen.map((branch) => branch.change)];
  }, [tips, nodes]);
  useEffect(() => {
    for (const branch of chosen) if (!peeked.has(branch.tip.id)) send("peek", { node: branch.tip.id });
  }, [tips]);
  return (
    <section class="comparison" aria-label="Comparison of branches">
      <Chart
        title="distance to the goal"
        data={data}
        labels={labels}
        colours={chosen.map((branch) => COLOURS[branch.id % COLOURS.length])}
        xLabel="step"
        height={200}
      />
      <div class="tips">
        {chosen.map((branch) => (
          <figure key={branch.id}>
            {peeked.has(branch.tip.id) ? (
              <img src={peeked.get(branch.tip.id)} alt={`Last frame of ${branch.change}`} />
            ) : (
              <div class="loading">…</div>
            )}
            <figcaption>
              <svg width="10" height="10" aria-hidden="true">
                <rect width="10" height="10" rx="2" fill={COLOURS[branch.id % COLOURS.length]} />
              </svg>{" "}
              step {branch.tip.step}: {branch.change}
            </figcaption>
          </figure>
        ))}
      </div>
    </section>
  );
}
