/** Runs one movement on several robots, and shows each run. */
import type { Account } from "../../shared/api/types";
import { RunSteps } from "../actions";
import { released } from "../actions/model";
import { StopBanner, StopOutcomes } from "../control";
import { actionUnavailableReason, ReachChip } from "../devices";
import type { DeviceSession } from "../control/model";
import type { DeviceStore, Fleet } from "../devices/model";
import { Card } from "../../shared/ui/card";
import { useEffect, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { ApiError } from "../../shared/api/http";
import { newId } from "../../shared/lib/ids";
import type { ObjectSchema, Parameters } from "../../shared/api/movement-library";
import { texts } from "./texts";
import { deviceAddress } from "../../shared/routing/routes";
import { ParameterFields, useParameters } from "./parameter-form";

/** The account's own robots of a type. Shared robots run their owners' movements. */
export function robotsOf(fleet: Fleet, robotType: string, account: string): { own: DeviceStore[]; others: DeviceStore[] } {
  const all = [...(fleet.devices.value?.values() ?? [])].filter(
    ({ info }) => info.value.robot_type === robotType && info.value.role !== "viewer",
  );
  const isOwn = ({ info }: DeviceStore): boolean => info.value.owner.id === account;
  return { own: all.filter(isOwn), others: all.filter((device) => !isOwn(device)) };
}

/** Always visible while robots are selected: one button, or one key, stops all of them. */
export function RunOnManyBar({ sessions }: { sessions: readonly DeviceSession[] }) {
  const running = sessions.filter(({ actions }) => isRunning(actions.run.value));
  return (
    <div class="control-bar" role="region" aria-label={texts.many.bar}>
      <p class="control-state" role="status" data-testid="many-state">
        <span class="dot" aria-hidden="true" />
        {running.length === 0 ? texts.many.chosen(sessions.length) : texts.many.running(running.length, sessions.length)}
      </p>
      {running.length > 0 && (
        <button
          type="button"
          data-testid="cancel-all"
          onClick={() => {
            for (const { actions } of running) void actions.cancel(null);
          }}
        >
          {running.length === 1 ? texts.movements.cancel : texts.many.cancelAll}
        </button>
      )}
      <button
        type="button"
        class="stop"
        data-testid="stop-all"
        title={texts.many.stopKeyExplained}
        aria-keyshortcuts="Escape"
        onClick={() => {
          for (const session of sessions) session.stopNow();
        }}
      >
        {sessions.length === 1 ? texts.many.stop : texts.many.stopAll} <kbd>{texts.many.stopKey}</kbd>
      </button>
      <StopOutcomes sessions={sessions} />
    </div>
  );
}

interface RunPanelProps {
  api: Api;
  fleet: Fleet;
  account: Account;
  robotType: string;
  movement: string;
  schema: ObjectSchema | null;
  sessions: readonly DeviceSession[];
  selected: readonly string[];
  onSelect: (chosen: readonly string[]) => void;
  /** Whether the text must be saved before running. */
  unsaved: boolean;
  /** Saves the text; returns whether it is saved. */
  beforeRun: () => Promise<boolean>;
}

export function RunPanel(props: RunPanelProps) {
  const { api, fleet, account, robotType, movement, schema, sessions, selected, onSelect, unsaved, beforeRun } = props;
  const [starting, setStarting] = useState(false);
  const [error, setError] = useState("");
  const values = useParameters(account.id, robotType, movement, schema);
  const { own, others } = robotsOf(fleet, robotType, account.id);
  const running = starting || sessions.some(({ actions }) => isRunning(actions.run.value));
  const ownIds = own.map(({ id }) => id).join(" ");

  // Deselect removed robots. No robot is preselected: with a selection, Escape is Stop even in the editor.
  useEffect(() => {
    const ids = ownIds.split(" ");
    const next = selected.filter((id) => ids.includes(id));
    if (next.length < selected.length) onSelect(next);
  }, [ownIds]);

  const run = async (): Promise<void> => {
    const parameters = values.submit();
    setError(parameters === null ? texts.parameters.fixErrors : "");
    if (parameters === null) return;
    setStarting(true);
    try {
      if (!unsaved || (await beforeRun())) await start(api, sessions, movement, parameters);
    } finally {
      setStarting(false);
    }
  };

  return (
    <Card title={texts.many.title} class="run-panel">
      <fieldset class="robots" disabled={running}>
        <legend>{texts.many.robots}</legend>
        {own.length === 0 && <p class="quiet">{texts.many.none}</p>}
        {own.map((device) => (
          <label key={device.id} class="robot-choice">
            <input
              type="checkbox"
              data-testid={`choose-${device.info.value.name}`}
              checked={selected.includes(device.id)}
              onChange={(event) =>
                onSelect(event.currentTarget.checked ? [...selected, device.id] : selected.filter((id) => id !== device.id))
              }
            />
            <span>
              {device.info.value.label} <span class="quiet small">{device.info.value.name}</span>
            </span>
            <ReachChip device={device} />
          </label>
        ))}
        {own.length > 1 && (
          <button type="button" class="plain" onClick={() => onSelect(own.map(({ id }) => id))}>
            {texts.many.chooseAll}
          </button>
        )}
        {others.length > 0 && <p class="quiet small">{texts.many.others(others.map(({ info }) => info.value.label))}</p>}
      </fieldset>
      <form
        class="parameter-form"
        onSubmit={(event) => {
          event.preventDefault();
          void run();
        }}
      >
        <h3>{texts.parameters.title}</h3>
        <ParameterFields values={values} disabled={running} />
        <div class="row">
          <button type="submit" class="primary" data-testid="run-many" disabled={running || sessions.length === 0}>
            {starting ? texts.many.starting : unsaved ? texts.many.saveAndRun(sessions.length) : texts.many.run(sessions.length)}
          </button>
          {values.fields.length > 0 && (
            <button type="button" class="plain" disabled={running} onClick={values.reset}>
              {texts.parameters.reset}
            </button>
          )}
        </div>
        <p class="field-error" role="alert">
          {error}
        </p>
      </form>
      <ul class="run-rows" aria-label={texts.many.rows}>
        {sessions.map((session) => (
          <RunRow key={session.device.id} session={session} />
        ))}
      </ul>
    </Card>
  );
}

/** One call starts all; each session follows its own action. */
async function start(api: Api, sessions: readonly DeviceSession[], movement: string, parameters: Parameters): Promise<void> {
  const request = { kind: "run_movement", name: movement, parameters } as const;
  const epochs = Object.fromEntries(
    sessions.flatMap(({ device, control }) => (control.epoch === null ? [] : [[device.id, control.epoch]])),
  );
  const ids = sessions.map(({ device }) => device.id);
  const results = api.library.runOnMany(ids, movement, parameters, epochs, newId());
  await Promise.all(
    sessions.map(({ device, actions }) =>
      actions.follow(
        request,
        results.then((items) => {
          const item = items.find((each) => each.device === device.id);
          if (item?.action === null || item === undefined) {
            throw new ApiError(item?.status ?? 500, "refused", item?.problem?.detail ?? texts.many.noAnswer);
          }
          return item.action;
        }),
      ),
    ),
  );
}

function RunRow({ session }: { session: DeviceSession }) {
  const { device, control, stop, actions } = session;
  const run = actions.run.value;
  const { label, name } = device.info.value;
  const unavailable = isRunning(run) ? "" : actionUnavailableReason(device, control);
  return (
    <li class="run-row" data-testid={`run-${name}`} data-status={run?.status ?? ""}>
      <div class="row">
        <a href={deviceAddress(device.id)}>
          <strong>{label}</strong> <span class="small">{name}</span>
        </a>
        <ReachChip device={device} />
        {isRunning(run) && (
          <button type="button" aria-label={texts.many.cancelOf(`${label} ${name}`)} onClick={() => void actions.cancel(null)}>
            {texts.movements.cancel}
          </button>
        )}
        <button type="button" class="stop" aria-label={texts.many.stopOf(`${label} ${name}`)} onClick={() => session.stopNow()}>
          {texts.many.stop}
        </button>
      </div>
      <div class={`run run-${run?.status ?? "none"}`} role="status">
        {run !== null && <RunSteps run={run} />}
        {run === null && unavailable !== "" && <p class="quiet">{unavailable}</p>}
      </div>
      {run !== null && run.output !== "" && (
        <pre class="output" tabIndex={0} aria-label={texts.many.outputOf(`${label} ${name}`)}>
          {run.output}
        </pre>
      )}
      <StopBanner device={device} stop={stop} />
    </li>
  );
}

function isRunning(run: DeviceSession["actions"]["run"]["value"]): boolean {
  return run !== null && !released(run);
}
