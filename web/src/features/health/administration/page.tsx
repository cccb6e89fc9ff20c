/** The state of the server, for administrators: parts, workers, installation, recent errors. */
import type { Api } from "../../../shared/api/client";
import type { Account } from "../../../shared/api/types";
import type { Installation, ServerPart } from "../../../shared/api/health";
import { common } from "../../../shared/i18n/common";
import { format } from "../../../shared/i18n/format";
import { usePolling } from "../../../shared/hooks/use-polling";
import { toPageClock } from "../../../shared/lib/clock";
import { Age } from "../../../shared/ui/age";
import { worstFirst } from "../model/server-parts";
import { texts } from "./texts";
import "./administration.css";

const EVERY_MS = 2_000;

export function AdministrationPage({ api, account }: { api: Api; account: Account }) {
  return (
    <main class="page administration" id="content">
      <h1>{texts.title}</h1>
      {account.administrator ? <State api={api} /> : <p class="notice bad">{texts.notAllowed}</p>}
    </main>
  );
}

function State({ api }: { api: Api }) {
  const { value, error } = usePolling(() => api.health.installation(), EVERY_MS, [api]);
  return (
    <>
      <p class="quiet">{texts.explained}</p>
      {error !== "" && (
        <p class="notice bad" role="alert" data-testid="administration-error">
          {texts.failed(error)} {value !== null && texts.outdated}
        </p>
      )}
      {value === null && error === "" && <p class="quiet">{common.loading}</p>}
      {value !== null && <Content state={value} />}
    </>
  );
}

function Content({ state }: { state: Installation }) {
  return (
    <>
      <p role="status" class={`notice ${state.status === "ok" ? "good" : state.status === "degraded" ? "warn" : "bad"}`} data-testid="overall" data-status={state.status}>
        {texts.summary[state.status]}
      </p>
      <section class="card">
        <h2>{texts.parts}</h2>
        <ul class="parts">
          {worstFirst(state.parts).map((part) => (
            <Part key={part.name} part={part} />
          ))}
        </ul>
      </section>
      <section class="card">
        <h2>{texts.installation}</h2>
        <Facts state={state} />
      </section>
      <section class="card">
        <h2>{texts.workers}</h2>
        {state.workers.length === 0 ? <p>{texts.noWorkers}</p> : <Workers state={state} />}
      </section>
      <section class="card">
        <h2>{texts.errors}</h2>
        <p class="quiet small">{texts.errorsExplained}</p>
        {state.errors.length === 0 && <p>{texts.noErrors}</p>}
        <ul class="logged">
          {state.errors.map((line) => (
            <li key={`${line.program} ${line.at} ${line.message}`}>
              <span class="quiet small">
                {format.recentTime(Date.parse(line.at))} · {line.program} · {line.level}
              </span>
              <code>{line.message}</code>
            </li>
          ))}
        </ul>
      </section>
    </>
  );
}

function Part({ part }: { part: ServerPart }) {
  return (
    <li class="part" data-testid={`part-${part.name}`} data-status={part.status}>
      <strong>{texts.part[part.name] ?? part.name}</strong>
      <span class="part-status">
        <span class={`chip ${part.status === "ok" ? "good" : part.status === "degraded" ? "warn" : "bad"}`}>{texts.status[part.status]}</span>
        <span class="quiet small">{texts.since(format.recentTime(Date.parse(part.since)))}</span>
      </span>
      <span class="part-message">{part.message}</span>
    </li>
  );
}

function Facts({ state }: { state: Installation }) {
  const facts = [
    [texts.fact.version, state.version],
    [texts.fact.broker, `${state.broker.kind}, ${state.broker.address}`],
    [texts.fact.agents, String(state.agents_online)],
    [texts.fact.devices, String(state.devices_online)],
    [texts.fact.tables, texts.size(state.tables_bytes)],
    [texts.fact.blobs, texts.size(state.blobs_bytes)],
    [texts.fact.free, texts.size(state.free_bytes)],
  ] as const;
  return (
    <dl class="facts">
      {facts.map(([name, value]) => (
        <div key={name}>
          <dt>{name}</dt>
          <dd>{value}</dd>
        </div>
      ))}
    </dl>
  );
}

function Workers({ state }: { state: Installation }) {
  return (
    <ul class="workers">
      {state.workers.map((worker) => (
        <li key={worker.name}>
          <dl class="facts">
            {(
              [
                [texts.worker.name, worker.name],
                [texts.worker.host, worker.host],
                [texts.worker.version, worker.version],
                [texts.worker.started, format.dateTime(worker.started_at)],
                [texts.worker.seen, <Age key="age" at={toPageClock(Date.parse(worker.seen_at))} />],
              ] as const
            ).map(([name, value]) => (
              <div key={name}>
                <dt>{name}</dt>
                <dd>{value}</dd>
              </div>
            ))}
          </dl>
        </li>
      ))}
    </ul>
  );
}
