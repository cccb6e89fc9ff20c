/** The keyframe editor, with or without a robot. */
import type { DeviceSession } from "../devices/model";
import { useEffect, useRef, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { begun, Drafts, Editor } from "./model/editor";
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

interface DeskProps {
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
  waits: boolean;
  /** `null`: without a robot, so recording and running are unavailable. */
  session: DeviceSession | null;
  /** The address of the editor for a movement's name. */
  address: (name: string) => string;
}

const drafts = new Drafts(localStorage);

export function KeyframeEditor(props: DeskProps) {
  const { api, session, name: first, source, robotType, robot, twin, measured, waits, address } = props;
  const begin = measured ?? props.home ?? null;
  const [name, setName] = useState(first);
  const [version, setVersion] = useState(source.version);
  const [editor, setEditor] = useState<Editor | null>(null);
  const draftOf = useRef(first);
  const [restored, setRestored] = useState(false);
  const [unkept, setUnkept] = useState(false);
  const ready = robot !== null && (!waits || source.saved !== null);

  // Created once: later changes of the robot or the connection must not affect the edited movement.
  useEffect(() => {
    if (!ready || editor !== null) return;
    const draft = drafts.read(robotType, first);
    setRestored(draft !== null && JSON.stringify(draft) !== JSON.stringify(source.saved));
    const from = { saved: source.saved, draft, fresh: begun(robot, begin) };
    setEditor(new Editor(robot, from, (movement) => setUnkept(!drafts.keep(robotType, draftOf.current, movement))));
  }, [ready, editor]);
  useEffect(() => () => editor?.dispose(), [editor]);
  useKeys(editor);

  if (editor === null) return <p class="quiet">{texts.waiting}</p>;
  const onSaved = (saved: string, at: number): void => {
    draftOf.current = saved;
    setName(saved);
    setVersion(at);
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
              if (source.saved === null) editor.change(begun(editor.robot, begin));
              else editor.revert();
              setRestored(false);
            }}
          >
            {source.saved === null ? texts.beginAnew : texts.revert}
          </button>
        </p>
      )}
      {unkept && <p class="notice warn">{texts.unkept}</p>}
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

/** Undo and redo by keys, except in text fields, which have their own. */
function useKeys(editor: Editor | null): void {
  useEffect(() => {
    if (editor === null) return undefined;
    const press = (event: KeyboardEvent): void => {
      const typing = event.target instanceof HTMLInputElement && event.target.type === "text";
      if (typing || !(event.ctrlKey || event.metaKey) || event.key.toLowerCase() !== "z") return;
      event.preventDefault();
      if (event.shiftKey) editor.redo();
      else editor.undo();
    };
    addEventListener("keydown", press);
    return () => removeEventListener("keydown", press);
  }, [editor]);
}
