// A plan session: its socket, the steps that were played, and the search that is shown.

import type { RefObject } from "preact";
import type { Model } from "./api";
import type { Reply } from "./session";
import { type Actions, type Connected, useSession } from "./use-session";

export interface PlanHeader {
  number: number;
  node: number;
  step: number;
  reward: number;
  total: number;
  distance: number | null;
  success: boolean;
  ended: boolean;
  playing: boolean;
  searching: boolean;
  left: number;
  state: number[];
  factors: Record<string, number[]>;
}

export interface Node {
  id: number;
  parent: number | null;
  branch: number;
  step: number;
  reward: number;
  total: number;
  distance: number | null;
  success: boolean;
  ended: boolean;
  cost: number | null;
  change: string | null;
  at: [number, number][];
}

export interface Path {
  iteration: number;
  rank: number | null;
  cost: number;
  lines: [number, number][][];
}

// Latents that a model predicts of the cheapest candidates, and those of the frames of what happens.
export interface Imagination {
  block: number;
  lines: { true: [number, number][]; imagined: [number, number][] }[];
  goal: [number, number];
  explained: number;
  error: number[];
  moved: number[];
  true_to_goal: number[];
  imagined_to_goal: number[];
  // The cheapest candidate as JPEGs in Base64, where a decoder was fitted.
  frames?: Decoded | null;
}

export interface Decoded {
  steps: number[];
  true: string[];
  decoded: string[];
  imagined: string[];
  // The frame of the goal, and the same through the decoder.
  goal: [string, string];
}

export interface Search {
  seconds: number;
  best: (number | null)[];
  mean: (number | null)[];
  elites: (number | null)[];
  spread: (number | null)[];
  iterations: { index: number; costs: number[]; elites: number; samples: number }[];
  names: string[];
  explained: number | null;
  paths: Path[];
  ends: { iteration: number; rank: number; cost: number; jpeg: string }[];
  imagination?: Imagination | null;
}

export interface Bounds {
  bytes: number;
  most_nodes: number;
  most_bytes: number;
}

interface State extends Connected {
  header?: PlanHeader;
  nodes: Map<number, Node>;
  bounds?: Bounds;
  search?: Search;
  // The step at which the search was made.
  searchAt?: number;
  searching?: { iteration: number; best: number };
  ready?: { model: Model; block: number; command: string };
  // The fit of a decoder: how far it is, or the fraction of the variance of pixels that it explains.
  fitting?: { done: number; total: number };
  explained?: number | null;
  goal?: string;
  peeked: Map<number, string>;
}

export type Plans = State & Actions;

const NONE: State = { nodes: new Map(), peeked: new Map(), isClosed: false };

const image = (jpeg: unknown) => `data:image/jpeg;base64,${jpeg}`;

// The state after a reply.
function after(state: State, reply: Reply): State {
  switch (reply.type) {
    case "tree": {
      const nodes = (reply.nodes as Node[]).map((node) => [node.id, node] as const);
      const bounds = reply as unknown as Bounds;
      const searchAt = nodes.some(([id]) => id === state.searchAt) ? state.searchAt : undefined;
      return { ...state, nodes: new Map(nodes), bounds, searchAt, search: searchAt === undefined ? undefined : state.search };
    }
    case "node": {
      const node = reply.node as Node;
      const bounds = state.bounds && { ...state.bounds, bytes: reply.bytes as number };
      return { ...state, nodes: new Map(state.nodes).set(node.id, node), bounds };
    }
    case "planned": {
      const search = reply.plan as Search;
      const at = reply.node as number;
      const node = state.nodes.get(at);
      const cost = search.best[search.best.length - 1];
      const nodes = node ? new Map(state.nodes).set(at, { ...node, cost }) : state.nodes;
      return { ...state, nodes, search, searchAt: at, searching: undefined };
    }
    case "searching":
      return { ...state, searching: reply as unknown as State["searching"] };
    case "ready":
      return { ...state, ready: reply as unknown as State["ready"], error: undefined };
    case "fitting":
      return { ...state, fitting: reply as unknown as State["fitting"] };
    case "decodes":
      return { ...state, fitting: undefined, explained: reply.explained as number | null };
    case "failed":
      return { ...state, fitting: undefined };
    case "goal":
      return { ...state, goal: image(reply.jpeg) };
    case "peeked":
      return { ...state, peeked: new Map(state.peeked).set(reply.node as number, image(reply.jpeg)) };
    default:
      return state;
  }
}

export function usePlans(env: string, side: number, canvas: RefObject<HTMLCanvasElement | null>): Plans {
  return useSession<PlanHeader, State>("plan", env, side, canvas, NONE, {
    frame: (state, header) => ({ ...state, header, searching: header.searching ? state.searching : undefined }),
    reply: after,
  });
}

// The steps from the first one to a step.
export function pathTo(nodes: Map<number, Node>, id: number | undefined): Node[] {
  const path: Node[] = [];
  for (let node = nodes.get(id ?? -1); node; node = nodes.get(node.parent ?? -1)) path.push(node);
  return path.reverse();
}

export interface Branch {
  id: number;
  // What it differs in from its parent branch.
  change: string;
  nodes: Node[];
  tip: Node;
}

// The branches in the order in which they began.
export function branches(nodes: Map<number, Node>): Branch[] {
  const found = new Map<number, Node[]>();
  for (const node of nodes.values()) found.set(node.branch, [...(found.get(node.branch) ?? []), node]);
  const all = [...found].sort(([a], [b]) => a - b);
  return all.map(([id, of]) => {
    const changes = of.map((node) => node.change).filter((change) => change !== null);
    const change = changes.length > 0 ? [...new Set(changes)].join("; ") : of[0].parent === null ? "start" : "planned again";
    return { id, change, nodes: of, tip: of[of.length - 1] };
  });
}
