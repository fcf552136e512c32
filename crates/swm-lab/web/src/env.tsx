// The page of environments: the list, and the environment that is chosen.

import { useState } from "preact/hooks";
import { type EnvInfo, type EnvRow, get } from "./api";
import { LiveEnv } from "./live-env";
import { type Params, patch, useLoaded } from "./state";

const FIRST = "swm/PushT-v1";

export function EnvPage({ params }: { params: Params }) {
  const list = useLoaded(() => get<EnvRow[]>("envs"), "envs");
  const id = params.env || FIRST;
  const info = useLoaded(() => get<EnvInfo>("env", { env: id }), id);
  return (
    <div class="envs">
      <EnvList rows={list.value ?? []} id={id} />
      {info.error && (
        <p class="error" role="alert">
          {info.error}
        </p>
      )}
      {info.value && <LiveEnv key={id} info={info.value} params={params} />}
      {!info.value && !info.error && <p class="loading">Loading {id} …</p>}
    </div>
  );
}

// Another environment has other factors.
export function chooseEnv(env: string): void {
  patch({ env, pin: undefined, variation: undefined, by: undefined, versus: undefined, view: undefined, beside: undefined });
}

function EnvList({ rows, id }: { rows: EnvRow[]; id: string }) {
  const [filter, setFilter] = useState("");
  const name = id.split(",")[0];
  const shown = rows.filter((row) => `${row.id} ${row.summary}`.toLowerCase().includes(filter.toLowerCase()));
  return (
    <aside class="list" aria-label="Environments">
      <input
        type="search"
        placeholder="Filter environments"
        aria-label="Filter environments"
        value={filter}
        onInput={(event) => setFilter(event.currentTarget.value)}
      />
      <select class="narrow" aria-label="Environment" value={name} onChange={(event) => chooseEnv(event.currentTarget.value)}>
        {rows.map((row) => (
          <option key={row.id} value={row.id}>
            {row.id}
          </option>
        ))}
      </select>
      <ul class="wide">
        {shown.map((row) => (
          <li key={row.id}>
            <button type="button" aria-current={row.id === name} title={row.summary} onClick={() => chooseEnv(row.id)}>
              <span>{row.id.replace("swm/", "")}</span>
              <small>{row.summary}</small>
            </button>
          </li>
        ))}
        {shown.length === 0 && <li class="muted">No environment contains “{filter}”.</li>}
      </ul>
    </aside>
  );
}
