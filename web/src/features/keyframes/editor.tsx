/** The keyframe editor, with or without a robot. */
import type { DeviceSession } from "../control/model";
import { useEffect, useRef, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { newMovement, Drafts, Editor } from "./model/editor";
import type { Positions, Robot } from "./model/keyframes";
import type { KnownTwin } from "../../shared/mqtt/parse-messages";
import { texts } from "./texts";
import { KeyframeInspector } from "./keyframe-inspector";
import "./keyframes.css";
import { RecordPanel } from "./record-panel";
import { SavePanel } from "./save-panel";
import type { MovementReference } from "./load-movement";
import { ProblemList, Timeline } from "./timeline";
import { PreviewTwin } from "./preview-twin";

interface KeyframeEditorProps {
  api: Api;
  /** The movement's name; empty: a new one. */
  name: string;
  source: MovementReference;
  robotType: string;
  /** `null` until loaded. */
  robot: Robot | null;
  twin: KnownTwin | null;
  measured: Positions | null;
  /** The initial pose of a new movement if no pose is measured. */
  home?: Positions;
  /** Whether a new movement must wait for the measured pose. */
  waitsForPose: boolean;
  /** `null`: without a robot, so recording and running are unavailable. */
  session: DeviceSession | null;
  /** The address of the editor for a movement's name. */
  address: (name: string) => string;
}

const drafts = new Drafts(localStorage);

export function KeyframeEditor(props: KeyframeEditorProps) {
  const { api, session, name: initialName, source, robotType, robot, twin, measured, waitsForPose, address } = props;
  const startPose = measured ?? props.home ?? null;
  const [name, setName] = useState(initialName);
  const [version, setVersion] = useState(source.version);
  const [editor, setEditor] = useState<Editor | null>(null);
  const draftName = useRef(initialName);
  const [restored, setRestored] = useState(false);
  const [draftFailed, setDraftFailed] = useState(false);
  const ready = robot !== null && (!waitsForPose || source.saved !== null);

  // Created once: later changes of the robot or the connection must not affect the edited movement.
  useEffect(() => {
    if (!ready || editor !== null) return;
    const draft = drafts.read(robotType, initialName);
    setRestored(draft !== null && JSON.stringify(draft) !== JSON.stringify(source.saved));
    const from = { saved: source.saved, draft, initial: newMovement(robot, startPose) };
    setEditor(new Editor(robot, from, (movement) => setDraftFailed(!drafts.storeDraft(robotType, draftName.current, movement))));
  }, [ready, editor]);
  useEffect(() => () => editor?.dispose(), [editor]);
  useKeys(editor);

  if (editor === null) return <p class="quiet">{texts.waiting}</p>;
  const onSaved = (saved: string, newVersion: number): void => {
    draftName.current = saved;
    setName(saved);
    setVersion(newVersion);
    setRestored(false);
    history.replaceState(null, "", address(saved));
  };
  return (
    <>
      {restored && (
        <p class="notice warn kf-restored" role="status" data-testid="kf-restored">
          {texts.restored}{" "}
          <button
            type="button"
            onClick={() => {
              if (source.saved === null) editor.change(newMovement(editor.robot, startPose));
              else editor.revert();
              setRestored(false);
            }}
          >
            {source.saved === null ? texts.startOver : texts.revert}
          </button>
        </p>
      )}
      {draftFailed && <p class="notice warn">{texts.draftNotStored}</p>}
      <div class="desk kf-desk">
        <div class="column">
          <PreviewTwin twin={twin} device={session?.device ?? null} editor={editor} />
          <Timeline editor={editor} measured={measured} />
          {session !== null && <RecordPanel device={session.device} editor={editor} />}
        </div>
        <div class="column">
          <SavePanel api={api} session={session} editor={editor} robotType={robotType} name={name} version={version} onSaved={onSaved} />
          <ProblemList editor={editor} />
          <KeyframeInspector editor={editor} measured={measured} />
        </div>
      </div>
    </>
  );
}

/** Keyboard shortcuts for undo and redo. Text fields use those of the browser. */
function useKeys(editor: Editor | null): void {
  useEffect(() => {
    if (editor === null) return undefined;
    const onKeyDown = (event: KeyboardEvent): void => {
      const typing = event.target instanceof HTMLInputElement && event.target.type === "text";
      if (typing || !(event.ctrlKey || event.metaKey) || event.key.toLowerCase() !== "z") return;
      event.preventDefault();
      if (event.shiftKey) editor.redo();
      else editor.undo();
    };
    addEventListener("keydown", onKeyDown);
    return () => removeEventListener("keydown", onKeyDown);
  }, [editor]);
}
