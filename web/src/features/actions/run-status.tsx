/** The device's current action: progress, result and undo. Always visible. */
import type { Control } from "../control/model";
import { actionUnavailableReason } from "../devices";
import type { DeviceStore } from "../devices/model";
import { useState } from "preact/hooks";
import { behaviourLabel } from "./model";
import { ended, released, type ActionRunner, type Run } from "./model/action-runner";
import { format } from "../../shared/i18n/format";
import type { KnownDescription } from "../../shared/mqtt/parse-messages";
import { describeRequest, texts } from "./texts";
import "./run-status.css";

interface RunStatusProps {
  device: DeviceStore;
  control: Control;
  actions: ActionRunner;
}

export function RunStatusPanel({ device, control, actions }: RunStatusProps) {
  const [dismissed, setDismissed] = useState("");
  const [error, setError] = useState("");
  const newest = actions.run.value;
  const run = newest === null || newest.key === dismissed ? null : newest;
  const reported = device.live.value ? (device.state.value?.action ?? null) : null;
  // A run with an unknown outcome may still be running, if the device says so.
  const ownRunning = run !== null && (!released(run) || reported?.id === run.id);
  const otherAction = !ownRunning && reported !== null && reported.id !== newest?.id ? reported : null;
  const visible = run !== null || otherAction !== null;
  const cancel = (): void => void actions.cancel(otherAction?.id ?? null).then(setError);
  return (
    <div class={`run-status ${ownRunning || otherAction !== null ? "running" : ""} ${visible ? "" : "empty"}`}>
      <div class={`run run-${run?.status ?? "none"}`} role="status" data-testid="action-status" data-status={run?.status ?? ""}>
        {run !== null && <RunSteps run={run} description={device.description.value} />}
        {otherAction !== null && <p>{texts.running(otherAction.kind, behaviourLabel(device.description.value, otherAction.name ?? ""))}</p>}
        {error !== "" && <p class="field-error">{error}</p>}
      </div>
      <div class="row">
        {(ownRunning || otherAction !== null) && device.info.value.role !== "viewer" && (
          <button type="button" data-testid="cancel-action" onClick={cancel}>
            {texts.cancel}
          </button>
        )}
        {run !== null && released(run) && (
          <>
            <UndoButton device={device} control={control} actions={actions} run={run} />
            <button type="button" class="plain" onClick={() => setDismissed(run.key)}>
              {texts.dismiss}
            </button>
          </>
        )}
      </div>
      {run !== null && run.output !== "" && (
        <details class="run-output" open>
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
export function RunSteps({ run, description = null }: { run: Run; description?: KnownDescription | null }) {
  const name = behaviourLabel(description, describeRequest(run.request));
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
      {run.progress !== null && !released(run) && <progress value={run.progress} max={1} aria-label={name} />}
      {run.reason !== "" && <p class={run.status === "done" ? "" : "field-error"}>{run.reason}</p>}
      {run.status === "unanswered" && <p class="field-error">{texts.unanswered}</p>}
    </>
  );
}

/** Undoes an ended action, including a partial one; not an action that never started. */
function UndoButton({ device, control, actions, run }: RunStatusProps & { run: Run }) {
  const { undo } = run;
  const started = run.steps.some(({ status }) => status === "started");
  if (undo === null || !started || !ended(run)) return null;
  const disabledReason = actionUnavailableReason(device, control);
  return (
    <button
      type="button"
      data-testid="undo-action"
      disabled={disabledReason !== ""}
      title={disabledReason === "" ? undefined : disabledReason}
      onClick={() => void actions.start(undo, control.epoch)}
    >
      {texts.undo}
    </button>
  );
}
