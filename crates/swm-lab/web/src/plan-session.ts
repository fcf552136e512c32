// A plan session: its socket, the steps that were played, and the search that is shown.

import { type RefObject } from "preact";
import { useCallback, useEffect, useRef, useState } from "preact/hooks";
import type { Model } from "./api";
import { open, type Send, type Session } from "./session";

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

export interface Plans {
  header?: PlanHeader;
  nodes: Map<number, Node>;
  bounds?: Bounds;
  search?: Search;
  // The step at which the search was made.
  searchAt?: number;
  searching?: { iteration: number; best: number };
  ready?: { model: Model; block: number; command: string };
  goal?: string;
  peeked: Map<number, string>;
  error?: string;
  isClosed: boolean;
  send: Send;
  reconnect: () => void;
  dismiss: () => void;
}

type State = Omit<Plans, "send" | "reconnect" | "dismiss">;
type Reply = { type: string } & Record<string, unknown>;

const NONE: State = { nodes: new Map(), peeked: new Map(), isClosed: false };
// How often the page shows what arrived, in milliseconds; frames themselves are drawn as they come.
const REFRESH = 60;

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
    case "goal":
      return { ...state, goal: image(reply.jpeg) };
    case "peeked":
      return { ...state, peeked: new Map(state.peeked).set(reply.node as number, image(reply.jpeg)) };
    case "failed":
      return { ...state, error: String(reply.message) };
    default:
      return state;
  }
}

export function usePlans(env: string, side: number, canvas: RefObject<HTMLCanvasElement | null>): Plans {
  const [state, setState] = useState<State>(NONE);
  const [attempt, setAttempt] = useState(0);
  const session = useRef<Session | undefined>(undefined);
  useEffect(() => {
    let now: State = NONE;
    let timer = 0;
    const publish = () => {
      timer = 0;
      setState(now);
    };
    const change = (next: State) => {
      now = next;
      timer ||= setTimeout(publish, REFRESH);
    };
    setState(NONE);
    session.current = open<PlanHeader>("plan", env, side, {
      frame: (header, bitmap) => {
        const to = canvas.current;
        if (to) {
          if (to.width !== bitmap.width) to.width = bitmap.width;
          if (to.height !== bitmap.height) to.height = bitmap.height;
          to.getContext("2d")?.drawImage(bitmap, 0, 0);
        }
        change({ ...now, header, searching: header.searching ? now.searching : undefined });
      },
      reply: (reply) => change(after(now, reply)),
      closed: () => change({ ...now, isClosed: true }),
    });
    return () => {
      clearTimeout(timer);
      session.current?.close();
    };
  }, [env, side, attempt]);
  const send: Send = useCallback((type, fields) => session.current?.send(type, fields), []);
  const reconnect = useCallback(() => setAttempt((n) => n + 1), []);
  const dismiss = useCallback(() => setState((old) => ({ ...old, error: undefined })), []);
  return { ...state, send, reconnect, dismiss };
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
