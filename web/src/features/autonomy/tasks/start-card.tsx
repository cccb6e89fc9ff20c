/** Starts a trial on one robot, and stops that robot. */
import { useState } from "preact/hooks";
import type { Api } from "../../../shared/api/client";
import { sentence } from "../../../shared/api/http";
import type { Task } from "../../../shared/api/tasks";
import type { Device } from "../../../shared/api/types";
import { newId } from "../../../shared/lib/ids";
import { deviceAddress } from "../../../shared/routing/routes";
import { Card } from "../../../shared/ui/card";
import { seedOf } from "../model";
import { texts } from "./texts";

/** Time for a slow simulation, reset and verdict, in addition to the time limit. */
const MARGIN_MS = 240_000;

interface StartCardProps {
  api: Api;
  task: Task;
  /** Robots of the task's type. */
  devices: readonly Device[];
  onStarted: () => void;
}

export function StartCard({ api, task, devices, onStarted }: StartCardProps) {
  const robots = devices.filter(({ role }) => role !== "viewer");
  const [chosen, setChosen] = useState("");
  const [seedText, setSeedText] = useState("");
  const [busy, setBusy] = useState(false);
  const [message, setMessage] = useState<{ text: string; bad: boolean }>({ text: "", bad: false });
  const device = robots.find(({ id }) => id === chosen)?.id ?? robots[0]?.id;
  if (device === undefined) {
    return (
      <Card title={texts.start}>
        <p class="quiet">{texts.noRobots}</p>
      </Card>
    );
  }
  const seed = seedOf(seedText);
  const start = async (): Promise<void> => {
    if (seed === undefined) return;
    setBusy(true);
    const request = { kind: "run_trial", name: task.name, seed } as const;
    try {
      const timeoutMs = Math.round(task.time_limit_s * 1000) + MARGIN_MS;
      const { reason } = await api.startAction(device, request, { epoch: null, waitFor: "started", timeoutMs }, newId());
      setMessage(reason === null ? { text: texts.started, bad: false } : { text: texts.rejected(reason.message), bad: true });
      onStarted();
    } catch (error) {
      setMessage({ text: texts.rejected(sentence(error)), bad: true });
    }
    setBusy(false);
  };
  const stop = async (): Promise<void> => {
    try {
      const { outcome } = await api.stop(device, "");
      setMessage({ text: texts.stopped[outcome], bad: outcome !== "confirmed" });
    } catch (error) {
      setMessage({ text: texts.stopFailed(sentence(error)), bad: true });
    }
  };
  return (
    <Card title={texts.start} data-testid="start-trial">
      <p class="quiet small">{texts.startExplained}</p>
      <form
        class="start-trial"
        onSubmit={(event) => {
          event.preventDefault();
          void start();
        }}
      >
        <label>
          {texts.robot}
          <select value={device} onChange={({ currentTarget }) => setChosen(currentTarget.value)}>
            {robots.map(({ id, label }) => (
              <option key={id} value={id}>
                {label}
              </option>
            ))}
          </select>
        </label>
        {task.resets && (
          <label>
            {texts.seed}
            <input type="text" inputMode="numeric" value={seedText} placeholder={texts.seedHint} onInput={({ currentTarget }) => setSeedText(currentTarget.value)} />
          </label>
        )}
        <button type="submit" class="primary" data-testid="run-trial" disabled={busy || seed === undefined}>
          {busy ? texts.starting : texts.run}
        </button>
        <button type="button" class="stop" data-testid="stop-trial" onClick={() => void stop()}>
          {texts.stop}
        </button>
      </form>
      <p>
        <a href={deviceAddress(device)}>{texts.openRobot}</a>
      </p>
      {seed === undefined && <p class="field-error">{texts.seedError}</p>}
      <p role={message.bad ? "alert" : "status"} class={message.bad ? "notice bad" : "quiet"} data-testid="start-message">
        {message.text}
      </p>
    </Card>
  );
}
