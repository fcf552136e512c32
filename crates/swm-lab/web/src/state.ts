// The state of a page is in the fragment of its URL: `#data?name=rooms.lance&episode=3`.

import { useCallback, useEffect, useRef, useState } from "preact/hooks";

export type Params = Record<string, string>;

export interface Place {
  page: string;
  params: Params;
}

export function read(): Place {
  const [page, query = ""] = location.hash.slice(1).split("?");
  return { page: page || "envs", params: Object.fromEntries(new URLSearchParams(query)) };
}

export function hash(page: string, params: Params): string {
  const query = new URLSearchParams(params).toString();
  return `#${page}${query ? `?${query}` : ""}`;
}

export function usePlace(): Place {
  const [place, setPlace] = useState(read);
  useEffect(() => {
    const changed = () => setPlace(read());
    addEventListener("hashchange", changed);
    return () => removeEventListener("hashchange", changed);
  }, []);
  return place;
}

// Changes some parameters of this page. An undefined or empty value removes its parameter.
export function patch(change: Record<string, string | undefined>): void {
  const { page, params } = read();
  const next = { ...params };
  for (const [key, value] of Object.entries(change)) {
    if (value === undefined || value === "") delete next[key];
    else next[key] = value;
  }
  const to = hash(page, next);
  if (to === location.hash) return;
  history.replaceState(null, "", to);
  dispatchEvent(new HashChangeEvent("hashchange"));
}

export interface Loaded<T> {
  value?: T;
  error?: string;
  again: () => void;
}

// Loads a value when `key` changes. Answers that arrive late are dropped.
export function useLoaded<T>(load: () => Promise<T>, key: string): Loaded<T> {
  const [state, setState] = useState<{ value?: T; error?: string; key: string }>({ key });
  const [count, setCount] = useState(0);
  const last = useRef("");
  useEffect(() => {
    let isCurrent = true;
    last.current = key;
    load().then(
      (value) => isCurrent && setState({ value, key }),
      (error) => isCurrent && setState({ error: String(error.message ?? error), key }),
    );
    return () => {
      isCurrent = false;
    };
  }, [key, count]);
  const again = useCallback(() => setCount((n) => n + 1), []);
  return state.key === key ? { value: state.value, error: state.error, again } : { again };
}

// Shortcuts of a page; keys typed into fields are left to them.
export function useKeys(keys: Record<string, (event: KeyboardEvent) => void>): void {
  const current = useRef(keys);
  current.current = keys;
  useEffect(() => {
    const pressed = (event: KeyboardEvent) => {
      const target = event.target as HTMLElement;
      const inField = target.closest("input:not([type=range]):not([type=checkbox]), select, textarea, dialog");
      const onControl = event.key === " " && target.closest("button, a, summary");
      if (inField || onControl || event.ctrlKey || event.metaKey || event.altKey) return;
      const action = current.current[event.key];
      if (!action) return;
      event.preventDefault();
      action(event);
    };
    addEventListener("keydown", pressed);
    return () => removeEventListener("keydown", pressed);
  }, []);
}

export function useTheme(): [string, () => void] {
  const themes = ["auto", "light", "dark"];
  const stored = () => {
    try {
      return localStorage.getItem("theme") ?? "auto";
    } catch {
      return "auto";
    }
  };
  const [theme, setTheme] = useState(stored);
  useEffect(() => {
    document.documentElement.dataset.theme = theme;
    try {
      localStorage.setItem("theme", theme);
    } catch {
      // The browser keeps nothing; the choice holds for this page.
    }
    dispatchEvent(new Event("theme"));
  }, [theme]);
  return [theme, () => setTheme(themes[(themes.indexOf(theme) + 1) % themes.length])];
}
