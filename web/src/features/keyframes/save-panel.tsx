/** Names a movement, saves it as a script and runs it on the robot. */
import { RunStatusPanel } from "../actions";
import { actionUnavailableReason } from "../devices";
import type { DeviceSession } from "../control/model";
import { Card } from "../../shared/ui/card";
import { useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { sentence } from "../../shared/api/http";
import type { Editor } from "./model/editor";
import { MAX_SCRIPT_LENGTH, writeScript } from "./model/script-codec";
import { MovementChanged } from "../../shared/api/movement-library";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";

interface SaveProps {
  api: Api;
  /** `null`: no robot to run it on. */
  session: DeviceSession | null;
  editor: Editor;
  robotType: string;
  /** The saved name; empty: not saved yet. */
  name: string;
  /** The base version; 0: none. */
  version: number;
  onSaved: (name: string, version: number) => void;
}

export function SavePanel({ api, session, editor, robotType, name, version, onSaved }: SaveProps) {
  const [enteredName, setEnteredName] = useState(name);
  const [busy, setBusy] = useState(false);
  const [message, setMessage] = useState("");
  const [newerVersion, setNewerVersion] = useState<number | null>(null);
  const movement = editor.movement.value;
  const errors = editor.problems.value.filter(({ severity }) => severity === "error").length;
  const source = writeScript(movement);
  const tooLong = source.length > MAX_SCRIPT_LENGTH;
  const validName = /^[A-Za-z0-9_-]{1,64}$/.test(enteredName);
  const changed = editor.changed.value || enteredName !== name;

  /** Returns whether it was saved. */
  const save = async (basedOn = enteredName === name ? version : 0): Promise<boolean> => {
    setBusy(true);
    setMessage("");
    setNewerVersion(null);
    try {
      const saved = await api.library.save(robotType, enteredName, source, basedOn);
      editor.saved(movement);
      onSaved(enteredName, saved.version);
      setMessage(texts.savedAs(saved.version));
      return true;
    } catch (error) {
      if (error instanceof MovementChanged) setNewerVersion(error.version);
      else setMessage(sentence(error));
      return false;
    } finally {
      setBusy(false);
    }
  };

  return (
    <Card title={texts.script} class="kf-save">
      <div class="row kf-names">
        <div class="field">
          <label for="kf-name">{texts.name}</label>
          <input
            id="kf-name"
            type="text"
            data-testid="kf-name"
            value={enteredName}
            autocomplete="off"
            spellcheck={false}
            aria-describedby="kf-name-note"
            onInput={(event) => setEnteredName(event.currentTarget.value)}
          />
        </div>
        <div class="field kf-description">
          <label for="kf-description">{texts.description}</label>
          <input
            id="kf-description"
            type="text"
            data-testid="kf-description"
            maxLength={200}
            value={movement.description}
            onInput={(event) => editor.change({ ...movement, description: event.currentTarget.value }, "description")}
            onBlur={() => editor.endGesture()}
          />
        </div>
      </div>
      <p class={validName || enteredName === "" ? "quiet small" : "field-error"} id="kf-name-note">
        {texts.nameNote}
      </p>
      <div class="row">
        <button type="button" data-testid="kf-save" disabled={busy || !validName || !changed || tooLong} onClick={() => void save()}>
          {busy ? texts.saving : texts.save}
        </button>
        {session !== null && (
          <Run session={session} name={enteredName} changed={changed} blocked={busy || !validName || tooLong} errors={errors} save={save} />
        )}
      </div>
      {session === null && <p class="quiet small">{texts.runsOnDevice}</p>}
      {tooLong && <p class="field-error">{texts.tooLong}</p>}
      <p role="status" data-testid="kf-save-status" data-version={version}>
        {message}
      </p>
      {newerVersion !== null && (
        <p class="notice warn" role="alert">
          {newerVersion === 0 ? texts.deleted : texts.newerVersion(newerVersion)}{" "}
          <button type="button" onClick={() => void save(newerVersion)}>
            {texts.overwrite}
          </button>
        </p>
      )}
      {session !== null && <RunStatusPanel device={session.device} control={session.control} actions={session.actions} />}
      <details>
        <summary>{texts.showScript}</summary>
        <pre class="output kf-source" tabIndex={0} data-testid="kf-source">
          {source}
        </pre>
      </details>
    </Card>
  );
}

interface RunProps {
  session: DeviceSession;
  name: string;
  /** Whether it must be saved before running. */
  changed: boolean;
  blocked: boolean;
  errors: number;
  save: () => Promise<boolean>;
}

function Run({ session, name, changed, blocked, errors, save }: RunProps) {
  const [speed, setSpeed] = useState(1);
  const unavailable = actionUnavailableReason(session.device, session.control);
  const run = async (): Promise<void> => {
    if (changed && !(await save())) return;
    await session.actions.start({ kind: "run_movement", name, parameters: { speed } }, session.control.epoch);
  };
  return (
    <>
      <button
        type="button"
        class="primary"
        data-testid="kf-run"
        disabled={blocked || errors > 0 || unavailable !== ""}
        onClick={() => void run()}
      >
        {changed ? texts.saveAndRun : texts.run}
      </button>
      <label class="kf-speed">
        {texts.speed}
        <select value={String(speed)} data-testid="kf-speed" onChange={(event) => setSpeed(Number(event.currentTarget.value))}>
          {[0.25, 0.5, 0.75, 1, 1.5, 2].map((one) => (
            <option key={one} value={String(one)}>
              {format.percent(one)}
            </option>
          ))}
        </select>
      </label>
      {errors > 0 && <p class="quiet small">{texts.fixFirst}</p>}
      {errors === 0 && unavailable !== "" && <p class="quiet small">{unavailable}</p>}
    </>
  );
}
