/** The device's current action: progress, result and undo. Always visible. */
import type { Control } from "../control/model";
import { actionUnavailableReason } from "../devices";
import type { DeviceStore } from "../devices/model";
import { useState } from "preact/hooks";
import { ended, type ActionRunner, type Run } from "./model/action-runner";
import { format } from "../../shared/i18n/format";
import { describeRequest, texts } from "./texts";
import "./run-status.css";

interface RunStatusProps {
  device: DeviceStore;
  control: Control;
  actions: ActionRunner;
}

export function RunStatusPanel({ device, control, actions }: RunStatusProps) {
  const [dismissed, setDismissed] = useState("");
  const [problem, setProblem] = useState("");
  const newest = actions.run.value;
  const run = newest === null || newest.key === dismissed ? null : newest;
  const told = device.live.value ? (device.state.value?.action ?? null) : null;
  const mineRuns = run !== null && !ended(run);
  const others = !mineRuns && told !== null && told.id !== newest?.id ? told : null;
  const shown = run !== null || others !== null;
  const cancel = (): void => void actions.cancel(others?.id ?? null).then(setProblem);
  return (
    <div class={`doing ${mineRuns || others !== null ? "running" : ""} ${shown ? "" : "nothing"}`}>
      <div class={`run run-${run?.status ?? "none"}`} role="status" data-testid="action-status" data-status={run?.status ?? ""}>
        {run !== null && <RunSteps run={run} />}
        {others !== null && <p>{texts.running(others.kind, others.name ?? "")}</p>}
        {problem !== "" && <p class="field-error">{problem}</p>}
      </div>
      <div class="row">
        {(mineRuns || others !== null) && device.info.value.role !== "viewer" && (
          <button type="button" data-testid="cancel-action" onClick={cancel}>
            {texts.cancel}
          </button>
        )}
        {run !== null && ended(run) && (
          <>
            <UndoButton device={device} control={control} actions={actions} run={run} />
            <button type="button" class="plain" onClick={() => setDismissed(run.key)}>
              {texts.dismiss}
            </button>
          </>
        )}
      </div>
      {run !== null && run.output !== "" && (
        <details class="printed" open>
          <summary>{texts.output}</summary>
          <pre class="output" tabIndex={0}>
            {run.output}
          </pre>
        </details>
      )}
    </div>
  );
}

/** The request, its steps and its progress. */
export function RunSteps({ run }: { run: Run }) {
  const name = describeRequest(run.request);
  return (
    <>
      <strong>{name}</strong>
      <ol class="steps">
        {run.steps.map((step) => (
          <li key={step.status}>
            {texts.status[step.status]}
            {step.afterMs > 0 && <span class="quiet"> {format.milliseconds(step.afterMs)}</span>}
          </li>
        ))}
      </ol>
      {run.progress !== null && !ended(run) && <progress value={run.progress} max={1} aria-label={name} />}
      {run.why !== "" && <p class={run.status === "done" ? "" : "field-error"}>{run.why}</p>}
      {run.status === "unanswered" && <p class="field-error">{texts.unanswered}</p>}
    </>
  );
}

/** Undoes an ended action, including a partial one; not an action that never started. */
function UndoButton({ device, control, actions, run }: RunStatusProps & { run: Run }) {
  const { back } = run;
  const begun = run.steps.some(({ status }) => status === "started");
  if (back === null || !begun) return null;
  const no = actionUnavailableReason(device, control);
  return (
    <button
      type="button"
      data-testid="back"
      disabled={no !== ""}
      title={no === "" ? undefined : no}
      onClick={() => void actions.start(back, control.epoch)}
    >
      {texts.back}
    </button>
  );
}
