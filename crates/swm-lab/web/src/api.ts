// The server's answers. Addresses are relative: the token is the first part of the page's path.

export interface Space {
  type: "Box" | "Discrete" | "MultiDiscrete" | "RGBBox";
  shape?: number[];
  dtype?: string;
  low?: (number | null)[];
  high?: (number | null)[];
  n?: number;
  nvec?: number[];
  start?: number | number[];
}

export interface Factor {
  key: string;
  space: Space;
  default: number[];
  sampled: boolean;
}

export interface EnvRow {
  id: string;
  summary: string;
  experts: string[];
}

export interface EnvInfo {
  id: string;
  summary: string;
  factors: Factor[];
  action: Space;
  max_episode_steps: number;
  experts: { id: string; summary: string }[];
  options: { key: string; summary: string; values: string[] }[];
  cameras: string[];
}

export interface Column {
  name: string;
  dtype: string;
  shape: number[];
  image: boolean;
}

export interface Dataset {
  folder: number;
  name: string;
  // The URI of a dataset in a source.
  location?: string;
  error?: string;
  env?: string;
  policy?: unknown;
  kind?: string;
  episodes?: number;
  steps?: number;
  bytes?: number;
  columns?: Column[];
}

// Where datasets are beside the folders: one dataset with its name, or a prefix.
export interface Source {
  folder: number;
  location: string;
  name: string | null;
}

export interface Episodes {
  index: number[];
  length: number[];
  returns: number[];
  success: boolean[];
  key: string;
}

// What an element of a column is in every episode.
export interface Values {
  min: (number | null)[];
  max: (number | null)[];
  mean: (number | null)[];
}

export interface Rows {
  rows: number;
  columns: { name: string; elements: number; values: (number | null)[] }[];
}

export interface Diagnosis {
  findings: { severity: "problem" | "note"; what: string; episodes: number[] }[];
  sound: number[];
}

export interface Run {
  folder: number;
  name: string;
  bytes: number;
  modified: number;
  last: Record<string, number>;
}

export interface Lines {
  offset: number;
  more: boolean;
  lines: Record<string, number>[];
}

export interface Model {
  name: string;
  family: string;
  block: number | null;
  image: number | null;
  history: number;
}

export interface Solver {
  id: string;
  summary: string;
  family: string;
  needs: string[];
  defaults: Record<string, unknown>;
}

export interface Planners {
  models: Model[];
  solvers: Solver[];
}

export interface Wrapper {
  id: string;
  summary: string;
  parameters: Record<string, { summary: string; allowed: string; default: unknown }>;
}

export type Query = Record<string, string | number | boolean | undefined>;

export function address(path: string, query: Query = {}): string {
  const given = Object.entries(query).filter(([, value]) => value !== undefined);
  const text = new URLSearchParams(given.map(([key, value]) => [key, String(value)])).toString();
  return `api/${path}${text ? `?${text}` : ""}`;
}

async function answer(path: string, query: Query, options?: RequestInit): Promise<Response> {
  const response = await fetch(address(path, query), options);
  if (response.ok) return response;
  const text = await response.text();
  let message = text.trim();
  try {
    message = JSON.parse(text).error;
  } catch {
    // The answer of a refused request is plain text.
  }
  throw new Error(message || `the lab answered ${response.status}`);
}

export async function get<T>(path: string, query: Query = {}): Promise<T> {
  return (await answer(path, query)).json();
}

export async function text(path: string, query: Query = {}): Promise<string> {
  return (await answer(path, query)).text();
}

export async function post<T>(path: string, body: unknown): Promise<T> {
  const headers = { "content-type": "application/json" };
  return (await answer(path, {}, { method: "POST", headers, body: JSON.stringify(body) })).json();
}
