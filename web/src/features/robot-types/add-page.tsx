/** Adds a robot type: choose files, preview, save. */
import { Card } from "../../shared/ui/card";
import { useEffect, useMemo } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { clock } from "../../shared/lib/clock";
import { UploadDraft } from "./model/upload-draft";
import { MANIFEST } from "./model/upload-files";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { robotTypeAddress, robotTypesAddress } from "../../shared/routing/routes";
import { FilePicker, SelectedFiles } from "./file-picker";
import { FindingsList } from "./findings-list";
import { UploadSummary } from "./upload-findings";
import { ModelViewer } from "./model-viewer";
import { StartAgent } from "./start-agent";
import "./robot-types.css";

export function AddRobotTypePage({ api }: { api: Api }) {
  const draft = useMemo(() => new UploadDraft(api.robotTypes), [api]);
  useEffect(() => () => draft.dispose(), [draft]);
  const words = texts.adding;
  return (
    <main class="page fleet robot-types" id="content" data-testid="add-type" data-step={draft.step.value}>
      <a href={robotTypesAddress}>← {texts.title}</a>
      <h1>{words.title}</h1>
      {draft.step.value === "saved" ? (
        <Saved draft={draft} />
      ) : (
        <>
          <Card title={words.files}>
            <p class="quiet">{words.explained}</p>
            <FilePicker draft={draft} />
          </Card>
          <Progress draft={draft} />
          <Outcome draft={draft} />
          <SelectedFiles draft={draft} />
        </>
      )}
    </main>
  );
}

/** The running step and its duration. */
function Progress({ draft }: { draft: UploadDraft }) {
  const step = draft.step.value;
  const words = texts.adding;
  const fault = draft.localError.value;
  return (
    <div role="status" data-testid="type-progress">
      {(step === "sending" || step === "checking" || step === "saving") && (
        <div class="card">
          <p>
            {words.progress[step]} <span class="quiet">{texts.seconds((clock.value - draft.since.value) / 1000)}</span>
          </p>
          <progress aria-label={words.progress[step]} />
        </div>
      )}
      {step === "invalid" && fault !== null && <p class="notice bad">{words.localError[fault](MANIFEST)}</p>}
      {draft.error.value !== "" && (
        <p class="notice bad row">
          <span>{words.unsent(draft.error.value)}</span>
          {step === "unsent" && (
            <button type="button" onClick={() => void draft.check()}>
              {common.tryAgain}
            </button>
          )}
        </p>
      )}
    </div>
  );
}

function Outcome({ draft }: { draft: UploadDraft }) {
  const words = texts.adding;
  const preview = draft.preview.value;
  const model = draft.model.value;
  const step = draft.step.value;
  const valid = preview !== null && (step === "valid" || step === "saving");
  return (
    <>
      <FindingsList findings={draft.errors.value} level="error" />
      <FindingsList findings={draft.warnings.value} level="warning" />
      {valid && (
        <>
          <Card title={words.valid(preview.robot_type.label)} class="save-type">
            <p>{words.previewNote}</p>
            <div class="row">
              <button
                type="button"
                class="primary"
                data-testid="save-type"
                disabled={step === "saving"}
                onClick={() => void draft.save()}
              >
                {words.save(preview.robot_type.type)}
              </button>
              <span class="quiet small">{words.expires(format.dateTime(preview.expires_at))}</span>
            </div>
          </Card>
          <div class="two">
            {model === null ? (
              <p class="quiet">{texts.model.none}</p>
            ) : (
              <ModelViewer twin={model.twin} joints={preview.robot_type.joints} />
            )}
            <UploadSummary type={preview.robot_type} model={model} files={draft.files.value} />
          </div>
        </>
      )}
    </>
  );
}

function Saved({ draft }: { draft: UploadDraft }) {
  const type = draft.saved.value;
  const words = texts.adding;
  if (type === null) return null;
  return (
    <>
      <Card title={words.saved(type.label, type.upload?.version ?? type.version)}>
        <p role="status" data-testid="type-saved">
          {words.savedExplained}
        </p>
        {draft.movements.value.length > 0 && (
          <ul class="plain-list" data-testid="saved-movements">
            {draft.movements.value.map(({ name, error }) => (
              <li key={name} data-accepted={error === ""}>
                <strong>{name}</strong>{" "}
                <span class={error === "" ? "quiet" : "field-error"}>{error === "" ? words.accepted : error}</span>
              </li>
            ))}
          </ul>
        )}
        <p class="row">
          <a href={robotTypeAddress(type.type)} data-testid="open-type">
            {words.open}
          </a>
          <button type="button" class="plain" onClick={() => void draft.clear()}>
            {words.another}
          </button>
        </p>
      </Card>
      <StartAgent type={type.type} builtIn={false} />
    </>
  );
}
