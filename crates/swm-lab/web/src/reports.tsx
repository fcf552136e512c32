// The page of results: results and studies, and the page of each in a frame that can neither run scripts nor reach the lab.

import { useState } from "preact/hooks";
import { address, get } from "./api";
import { ago } from "./format";
import { useInterval, useStaying } from "./runs";
import { type Params, patch, useLoaded } from "./state";

interface Report {
  folder: number;
  name: string;
  kind: "results" | "study" | "autopsy" | "leaderboard";
  modified: number;
  title: string;
  lines: string[];
  // The pages of the entries of a leaderboard.
  pages: string[];
  error?: string;
}

// How often the list is read, in milliseconds: studies fill in.
const LIST = 5000;

const keyOf = (report: Report) => `${report.folder}:${report.name}`;

export function ReportsPage({ params }: { params: Params }) {
  const loaded = useStaying(useLoaded(() => get<{ folders: string[]; reports: Report[] }>("reports"), "reports"));
  useInterval(loaded.again, LIST);
  const [filter, setFilter] = useState("");
  const reports = loaded.value?.reports ?? [];
  const shown = reports.filter((report) => `${report.name} ${report.title}`.toLowerCase().includes(filter.toLowerCase()));
  const chosen = reports.find((report) => keyOf(report) === params.report);
  return (
    <div class="reports">
      <aside class="list" aria-label="Results and studies">
        <input
          type="search"
          placeholder="Filter results"
          aria-label="Filter results"
          value={filter}
          onInput={(event) => setFilter(event.currentTarget.value)}
        />
        <ul>
          {shown.map((report) => (
            <li key={keyOf(report)}>
              <button type="button" aria-current={report === chosen} onClick={() => patch({ report: keyOf(report), entry: undefined })}>
                <span>{report.name}</span>
                <small>
                  {report.kind === "results" ? "" : `${report.kind}, `}
                  {report.title}, {ago(Date.now() / 1000 - report.modified)}
                </small>
                {report.lines.map((line) => (
                  <small key={line}>{line}</small>
                ))}
                {report.error && <small class="error">{report.error}</small>}
              </button>
            </li>
          ))}
        </ul>
        {loaded.value && reports.length === 0 && (
          <p class="muted">
            No results in {loaded.value.folders.join(", ")}. <code>swm eval --output DIR</code> writes some;{" "}
            <code>swm lab --results DIR</code> adds a folder.
          </p>
        )}
        {loaded.error && <p class="error">{loaded.error}</p>}
      </aside>
      <section class="report" aria-label="Report">
        {chosen ? <Page report={chosen} entry={chosen.pages.find((page) => page === params.entry)} /> : <p class="loading">Choose results or a study.</p>}
      </section>
    </div>
  );
}

function Page({ report, entry }: { report: Report; entry?: string }) {
  const page = address("report", { folder: report.folder, name: report.name, entry });
  if (report.error) {
    return (
      <p class="error" role="alert">
        {report.error}
      </p>
    );
  }
  return (
    <>
      <div class="bar">
        <h1>
          {report.name} <small>{report.title}</small>
        </h1>
        <span class="grow" />
        {report.pages.length > 0 && (
          <label>
            page
            <select aria-label="Page" value={entry ?? ""} onChange={(event) => patch({ entry: event.currentTarget.value })}>
              <option value="">tables</option>
              {report.pages.map((name) => (
                <option key={name} value={name}>
                  {name.replace(/\.html$/, "")}
                </option>
              ))}
            </select>
          </label>
        )}
        <a class="button" href={page} target="_blank" rel="noreferrer">
          Open
        </a>
      </div>
      <iframe key={`${page} ${report.lines.join()}`} src={page} title={`Report of ${report.name}`} sandbox="allow-popups allow-popups-to-escape-sandbox" />
    </>
  );
}
