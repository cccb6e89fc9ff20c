import { useDeviceSessions } from "../control";
/** One movement: its script, errors, versions and runs. */
import type { Account } from "../../shared/api/types";
import type { DeviceSession } from "../control/model";
import type { Fleet } from "../devices/model";
import { readScript } from "../keyframes/model";
import { Age } from "../../shared/ui/age";
import { Card } from "../../shared/ui/card";
import { useSignalEffect } from "@preact/signals";
import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { now } from "../../shared/lib/clock";
import { sentence } from "../../shared/api/http";
import { storedDraft } from "../../shared/lib/local-storage";
import type { CheckResult, Scripting } from "../../shared/api/movement-library";
import { ScriptDraft } from "./model/script-draft";
import { failureMark, rangeOf, type TextRange } from "./model/text-offsets";
import { common } from "../../shared/i18n/common";
import { texts } from "./texts";
import { movementsAddress, typeKeyframesAddress } from "../../shared/routing/routes";
import { CodeEditor } from "./code-editor";
import { RunOnManyBar, RunPanel, robotsOf } from "./run-on-many";
import { storage } from "../../shared/hooks/browser-storage";
import { ScriptDiff, VersionList } from "./version-list";
import "./movements.css";

interface EditorPageProps {
  api: Api;
  fleet: Fleet;
  account: Account;
  robotType: string;
  name: string;
}

export function EditorPage({ api, fleet, account, robotType, name }: EditorPageProps) {
  const script = useMemo(
    () => new ScriptDraft(api.library, robotType, name, storedDraft(storage(), account.id, robotType, name), texts.library.template),
    [api, account, robotType, name],
  );
  const [selected, setSelected] = useState<readonly string[]>([]);
  const devices = robotsOf(fleet, robotType, account.id).own.filter(({ id }) => selected.includes(id));
  const sessions = useDeviceSessions(api, fleet, devices, account);
  const loading = script.loading.value;
  useEffect(() => void script.load(), [script]);
  return (
    <>
      {sessions.length > 0 && <RunOnManyBar sessions={sessions} />}
      <main class="page operate movement-page" id="content">
        <div class="heading">
          <a href={movementsAddress}>← {texts.library.title}</a>
          <h1>{name}</h1>
          <p class="quiet">
            {robotType.replaceAll("_", " ")}
            {loading.kind === "loaded" && <AsKeyframes script={script} />}
          </p>
        </div>
        {loading.kind === "loading" && (
          <p class="quiet" role="status">
            {common.loading}
          </p>
        )}
        {loading.kind === "failed" && (
          <p class="notice bad" role="alert">
            {texts.editor.failed(loading.saveError)}{" "}
            <button type="button" onClick={() => void script.load()}>
              {texts.movements.retry}
            </button>
          </p>
        )}
        {loading.kind === "loaded" && (
          <Desk
            api={api}
            fleet={fleet}
            account={account}
            script={script}
            sessions={sessions}
            selected={selected}
            onSelect={setSelected}
          />
        )}
      </main>
    </>
  );
}

/** A link to the keyframe editor, for scripts that it wrote. */
function AsKeyframes({ script }: { script: ScriptDraft }) {
  const saved = script.base.value?.source;
  if (saved === undefined || script.changed.value || readScript(saved).kind !== "keyframes") return null;
  return (
    <>
      {" · "}
      <a href={typeKeyframesAddress(script.robotType, script.name)} data-testid="as-keyframes">
        {texts.editor.asKeyframes}
      </a>
    </>
  );
}

interface DeskProps {
  api: Api;
  fleet: Fleet;
  account: Account;
  script: ScriptDraft;
  sessions: readonly DeviceSession[];
  selected: readonly string[];
  onSelect: (selected: readonly string[]) => void;
}

function Desk({ api, fleet, account, script, sessions, selected, onSelect }: DeskProps) {
  const { robotType, name } = script;
  const [checked, setChecked] = useState<{ of: string; found: CheckResult } | null>(null);
  const base = script.base.value;
  const unsaved = script.changed.value;
  // Use the unsaved script's PARAMETERS if they are valid.
  const schema = unsaved && checked?.found.savable === true ? checked.found.parameters_schema : (base?.parameters_schema ?? null);
  return (
    <div class="desk">
      <div class="column">
        <Code api={api} fleet={fleet} script={script} sessions={sessions} checked={checked} onChecked={setChecked} />
      </div>
      <div class="column">
        <RunPanel
          api={api}
          fleet={fleet}
          account={account}
          robotType={robotType}
          movement={name}
          schema={schema}
          sessions={sessions}
          selected={selected}
          onSelect={onSelect}
          unsaved={unsaved}
          beforeRun={() => script.save()}
        />
        <VersionList
          api={api}
          robotType={robotType}
          name={name}
          newest={base?.version ?? 0}
          text={script.text.value}
          onRestore={async (source) => {
            script.edit(source);
            await script.save();
          }}
        />
      </div>
    </div>
  );
}

interface CodeProps {
  api: Api;
  fleet: Fleet;
  script: ScriptDraft;
  sessions: readonly DeviceSession[];
  checked: { of: string; found: CheckResult } | null;
  onChecked: (checked: { of: string; found: CheckResult }) => void;
}

function Code({ api, fleet, script, sessions, checked, onChecked }: CodeProps) {
  const host = useRef<HTMLDivElement>(null);
  const editor = useRef<CodeEditor | null>(null);
  const saveButton = useRef<HTMLButtonElement>(null);
  const parameters = useRef<readonly string[]>([]);
  const failure = useRef<{ of: string; marks: readonly TextRange[] }>({ of: "", marks: [] });
  const [marks, setMarks] = useState<readonly TextRange[]>([]);
  const [checkError, setCheckError] = useState("");
  parameters.current = Object.keys(checked?.found.parameters_schema?.properties ?? {});

  useEffect(() => {
    if (host.current === null) return undefined;
    let scripting: Scripting | null = null;
    void api.library.scripting(script.robotType).then((found) => {
      scripting = { ...found, names: { ...found.names, devices: deviceNames(fleet) } };
    }, () => undefined); // Completions are unavailable then; the check reports an unreachable server.
    const made = new CodeEditor(host.current, {
      text: script.text.value,
      label: texts.editor.label(script.name),
      description: texts.editor.keys,
      scripting: () => scripting,
      parameters: () => parameters.current,
      check: async (text) => {
        try {
          const found = await api.library.check(script.robotType, text);
          onChecked({ of: text, found });
          setCheckError("");
          const all = [...found.diagnostics.map((mark) => rangeOf(text, mark)), ...(failure.current.of === text ? failure.current.marks : [])];
          setMarks(all);
          return all;
        } catch (error) {
          setCheckError(sentence(error));
          return [];
        }
      },
      onChange: (text) => script.edit(text),
      onSave: () => void script.save(),
      onLeave: () => saveButton.current?.focus(),
    });
    editor.current = made;
    return () => {
      made.dispose();
      editor.current = null;
    };
  }, [api, fleet, script]);

  // Text replaced by the model: another version, or the saved one.
  useSignalEffect(() => {
    const text = script.text.value;
    if (editor.current !== null && editor.current.text !== text) editor.current.replace(text);
  });

  const why = sessions.map(({ actions }) => actions.run.value).find((run) => run?.status === "failed")?.reason ?? "";
  useEffect(() => {
    const mark = failureMark(why);
    const text = script.text.peek();
    failure.current = mark === null ? { of: "", marks: [] } : { of: text, marks: [rangeOf(text, mark)] };
    editor.current?.checkAgain();
  }, [script, why]);

  return (
    <Card title={texts.editor.title} class="code-card" aside={<SaveState script={script} />}>
      <Restored script={script} />
      <div class="code-editor" data-testid="code" data-checked={String(checked?.of === script.text.value)} ref={host} />
      <div class="row">
        <button
          type="button"
          class="primary"
          ref={saveButton}
          data-testid="save-movement"
          disabled={script.saving.value || !script.changed.value}
          aria-keyshortcuts="Control+S"
          onClick={() => void script.save()}
        >
          {script.saving.value ? texts.editor.saving : texts.editor.save}
        </button>
        <span class="quiet small">{texts.editor.keys}</span>
      </div>
      <div role="alert">
        {script.saveError.value !== "" && (
          <p class="notice bad" data-testid="save-refused">
            {texts.editor.refused(script.saveError.value)}
          </p>
        )}
        <ConflictNotice script={script} />
      </div>
      {checkError !== "" && <p class="notice warn">{texts.editor.checkError(checkError)}</p>}
      <Problems marks={marks} text={script.text.value} onGo={(mark) => editor.current?.goTo(mark.from)} />
    </Card>
  );
}

function deviceNames(fleet: Fleet): string[] {
  return [...new Set([...(fleet.devices.value?.values() ?? [])].map(({ info }) => info.value.name))].sort();
}

function SaveState({ script }: { script: ScriptDraft }) {
  const base = script.base.value;
  const text =
    base === null
      ? texts.editor.unsaved
      : script.changed.value
        ? texts.editor.changed(base.version)
        : texts.editor.isSaved(base.version, base.built_in);
  return (
    <span class="quiet small" role="status" data-testid="save-state" data-version={base?.version ?? 0} data-changed={String(script.changed.value)}>
      {text}
    </span>
  );
}

/** A notice that unsaved text was restored, with a button to discard it. */
function Restored({ script }: { script: ScriptDraft }) {
  const [discarded, setDiscarded] = useState<string | null>(null);
  const at = script.restored.value;
  if (discarded !== null && !script.changed.value) {
    return (
      <p class="notice" role="status">
        {texts.editor.discarded}{" "}
        <button
          type="button"
          onClick={() => {
            script.edit(discarded);
            setDiscarded(null);
          }}
        >
          {texts.editor.undo}
        </button>
      </p>
    );
  }
  if (at === null) return null;
  return (
    <p class="notice warn" role="status" data-testid="restored">
      <Age at={now() - Math.max(0, Date.now() - at)} as={texts.editor.restored} />{" "}
      <button type="button" data-testid="discard-draft" onClick={() => setDiscarded(script.discard())}>
        {texts.editor.discard}
      </button>
    </p>
  );
}

function ConflictNotice({ script }: { script: ScriptDraft }) {
  const conflict = script.conflict.value;
  if (conflict === null) return null;
  const { theirs } = conflict;
  return (
    <div class="notice warn conflict" data-testid="conflict">
      <p>{theirs === null ? texts.editor.deleted : texts.editor.conflict(theirs.version, theirs.updated_at)}</p>
      {theirs !== null && (
        <ScriptDiff before={theirs.source} after={script.text.value} label={texts.editor.bothLabel(theirs.version)} />
      )}
      <div class="row">
        <button type="button" data-testid="save-over" onClick={() => void script.saveOver()}>
          {texts.editor.saveMine}
        </button>
        {theirs !== null && (
          <button type="button" data-testid="take-theirs" onClick={() => script.takeTheirs()}>
            {texts.editor.takeTheirs(theirs.version)}
          </button>
        )}
      </div>
    </div>
  );
}

interface ProblemsProps {
  marks: readonly TextRange[];
  text: string;
  onGo: (mark: TextRange) => void;
}

/** The findings as a list, for users who cannot see or reach the marks in the text. */
function Problems({ marks, text, onGo }: ProblemsProps) {
  return (
    <section aria-label={texts.editor.problems}>
      <p class="quiet small" role="status" data-testid="problem-count" data-count={marks.length}>
        {texts.editor.count(marks.filter((mark) => mark.severity === "error").length, marks.length)}
      </p>
      <ul class="problems">
        {marks.map((mark) => {
          const line = text.slice(0, mark.from).split("\n").length;
          return (
            <li key={`${mark.from}-${mark.message}`} class={mark.severity} data-testid="problem" data-line={line}>
              <button type="button" class="plain" onClick={() => onGo(mark)}>
                {texts.editor.line(line)}
              </button>{" "}
              {mark.message}
            </li>
          );
        })}
      </ul>
    </section>
  );
}
