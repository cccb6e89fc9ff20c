import { useEffect, useState } from "preact/hooks";
import { ended, type ActionRunner, type Run } from "../core/action";
import { sentence, type Api, type Movement } from "../core/api";
import type { Control } from "../core/control";
import type { DeviceStore } from "../core/device";
import { texts } from "../texts";
import { Card } from "./parts";

interface MovementsProps {
  api: Api;
  device: DeviceStore;
  control: Control;
  actions: ActionRunner;
}

type Library = { kind: "loading" } | { kind: "there"; items: readonly Movement[] } | { kind: "failed"; why: string };

export function Movements({ api, device, control, actions }: MovementsProps) {
  const [library, setLibrary] = useState<Library>({ kind: "loading" });
  const [tries, setTries] = useState(0);
  const { id, role } = device.info.value;
  const watches = role === "viewer";
  useEffect(() => {
    if (watches) return undefined;
    let wanted = true;
    setLibrary({ kind: "loading" });
    api.movements(id).then(
      (items) => wanted && setLibrary({ kind: "there", items }),
      (error: unknown) => wanted && setLibrary({ kind: "failed", why: sentence(error) }),
    );
    return () => {
      wanted = false;
    };
  }, [api, id, watches, tries]);

  const run = actions.run.value;
  const running = (run !== null && !ended(run)) || (device.live.value && device.state.value?.mode === "action");
  const blocked = running || device.stopped.value || device.reach.value === "offline";
  return (
    <Card title={texts.movements.title} class="movements">
      {watches && <p class="quiet">{texts.control.watches}</p>}
      {!watches && library.kind === "loading" && <p class="quiet">{texts.loading}</p>}
      {library.kind === "failed" && (
        <p class="notice bad">
          {texts.movements.failed(library.why)}{" "}
          <button type="button" onClick={() => setTries(tries + 1)}>
            {texts.movements.retry}
          </button>
        </p>
      )}
      {library.kind === "there" && library.items.length === 0 && <p class="quiet">{texts.movements.none}</p>}
      {library.kind === "there" && (
        <ul class="movement-list">
          {library.items.map((movement) => (
            <li key={movement.name}>
              <span>
                <strong>{movement.name}</strong>
                {!movement.built_in && <span class="chip">{texts.movements.own}</span>}
                <span class="quiet small">{movement.description}</span>
              </span>
              <button
                type="button"
                data-testid={`movement-${movement.name}`}
                aria-label={texts.movements.runNamed(movement.name)}
                disabled={blocked}
                onClick={() => void actions.start(movement.name, control.epoch)}
              >
                {texts.movements.run}
              </button>
            </li>
          ))}
        </ul>
      )}
      <RunStatus device={device} run={run} actions={actions} />
    </Card>
  );
}

interface RunStatusProps {
  device: DeviceStore;
  run: Run | null;
  actions: ActionRunner;
}

function RunStatus({ device, run, actions }: RunStatusProps) {
  const told = device.live.value ? device.state.value?.action : null;
  const mineRuns = run !== null && !ended(run);
  const othersRun = !mineRuns && told !== null && told !== undefined && told.id !== run?.id;
  return (
    <>
      <div class={`run run-${run?.status ?? "none"}`} role="status" data-testid="action-status" data-status={run?.status ?? ""}>
        {run !== null && (
          <>
            <strong>{run.movement}</strong>
            <ol class="steps">
              {run.steps.map((step) => (
                <li key={step.status}>
                  {texts.movements.status[step.status]}
                  {step.afterMs > 0 && <span class="quiet"> {texts.number.milliseconds(step.afterMs)}</span>}
                </li>
              ))}
            </ol>
            {run.progress !== null && !ended(run) && <progress value={run.progress} max={1} aria-label={run.movement} />}
            {run.why !== "" && <p class={run.status === "done" ? "" : "field-error"}>{run.why}</p>}
          </>
        )}
        {othersRun && <p>{texts.movements.running(told.name === undefined || told.name === "" ? told.kind : told.name)}</p>}
      </div>
      {(mineRuns || othersRun) && device.info.value.role !== "viewer" && (
        <button type="button" data-testid="cancel-action" onClick={() => void actions.cancel(othersRun ? told.id : null)}>
          {texts.movements.cancel}
        </button>
      )}
      {run !== null && run.output !== "" && (
        <>
          <h3>{texts.movements.output}</h3>
          <pre class="output" tabIndex={0}>
            {run.output}
          </pre>
        </>
      )}
    </>
  );
}
