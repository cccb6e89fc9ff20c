/** The timeline: keyframe markers, moved by dragging or keys, and the preview's playhead. */
import { stretchAll } from "./model/problems";
import { Card } from "../../shared/ui/card";
import { useRef } from "preact/hooks";
import type { Editor } from "./model/editor";
import { ACTION_KINDS, setTime, MIN_INTERVAL_S, type Keyframe, type Positions } from "./model/keyframes";
import { texts } from "./texts";

interface TimelineProps {
  editor: Editor;
  measured: Positions | null;
}

const TICKS = [0.25, 0.5, 1, 2, 5, 10, 20, 60, 120];
const MAX_TICKS = 9;

export function Timeline({ editor, measured }: TimelineProps) {
  const playing = editor.playing.value;
  const { keyframes } = editor.movement.value;
  const time_s = editor.plan.value.keyframeTime(editor.at.value);
  const last = keyframes.at(-1)?.time_s ?? 0;
  return (
    <Card title={texts.timeline} class="kf-timeline" aside={<History editor={editor} />}>
      <div class="row kf-transport">
        <button
          type="button"
          class="primary"
          data-testid="kf-play"
          aria-pressed={playing}
          disabled={keyframes.length < 2}
          onClick={() => (playing ? editor.pause() : editor.play())}
        >
          {playing ? texts.pause : texts.play}
        </button>
        <span class="kf-clock" data-testid="kf-clock">
          {texts.ofSeconds(time_s, last)}
        </span>
        <span class="quiet small">{texts.previewOnly}</span>
      </div>
      <Track editor={editor} time_s={time_s} last={last} />
      <div class="row kf-actions">
        <button type="button" data-testid="kf-add" onClick={() => editor.add(editor.poseAtKeyframe(editor.selected.value))}>
          {texts.add}
        </button>
        <button
          type="button"
          data-testid="kf-add-measured"
          disabled={measured === null}
          title={measured === null ? texts.notLive : undefined}
          onClick={() => measured !== null && editor.add(measured)}
        >
          {texts.addMeasured}
        </button>
        <button type="button" data-testid="kf-duplicate" onClick={() => editor.duplicateSelected()}>
          {texts.duplicate}
        </button>
        <button type="button" data-testid="kf-delete" disabled={keyframes.length < 2} onClick={() => editor.deleteSelected()}>
          {texts.remove}
        </button>
      </div>
      <p class="quiet small">{texts.timelineKeys}</p>
    </Card>
  );
}

function History({ editor }: { editor: Editor }) {
  return (
    <span class="row">
      <button type="button" class="plain" data-testid="kf-undo" disabled={!editor.canUndo.value} onClick={() => editor.undo()}>
        {texts.undo}
      </button>
      <button type="button" class="plain" data-testid="kf-redo" disabled={!editor.canRedo.value} onClick={() => editor.redo()}>
        {texts.redo}
      </button>
    </span>
  );
}

function Track({ editor, time_s, last }: { editor: Editor; time_s: number; last: number }) {
  const track = useRef<HTMLDivElement>(null);
  const span = Math.max(2, last * 1.06);
  const { keyframes } = editor.movement.value;
  const invalid = new Set(editor.problems.value.map(({ keyframe }) => keyframe));
  const fast = new Set(editor.problems.value.flatMap(({ keyframe, what }) => (what.kind === "too-fast" ? [keyframe] : [])));
  const every = TICKS.find((step) => span / step <= MAX_TICKS) ?? 120;
  const ticks = Array.from({ length: Math.floor((0.96 * span) / every) + 1 }, (_, index) => index * every);
  const timeAt = (clientX: number): number => {
    const box = track.current?.getBoundingClientRect();
    return box === undefined ? 0 : ((clientX - box.left) / box.width) * span;
  };
  const at = (time: number): Record<string, string> => ({ "--at": String(time / span) });
  return (
    <div class="kf-track-box">
      <div class="kf-track" ref={track} data-testid="kf-track" data-span={span}>
        <div
          class="kf-ruler"
          aria-hidden="true"
          onPointerDown={(event) => {
            event.currentTarget.setPointerCapture(event.pointerId);
            editor.scrub(timeAt(event.clientX));
          }}
          onPointerMove={(event) => {
            if (event.currentTarget.hasPointerCapture(event.pointerId)) editor.scrub(timeAt(event.clientX));
          }}
        >
          {ticks.map((tick) => (
            <span key={tick} class="kf-tick" style={at(tick)}>
              {texts.tick(tick)}
            </span>
          ))}
        </div>
        <div class="kf-line" aria-hidden="true">
          {keyframes.slice(1).map((one, index) => (
            <span
              key={index}
              class={`kf-segment ${fast.has(index + 1) ? "fast" : ""}`}
              style={{ ...at(keyframes[index]?.time_s ?? 0), "--to": String(one.time_s / span) }}
            />
          ))}
        </div>
        {keyframes.map((one, index) => (
          <Marker key={index} editor={editor} index={index} one={one} invalid={invalid.has(index)} style={at(one.time_s)} timeAt={timeAt} />
        ))}
        <div
          class="kf-playhead"
          role="slider"
          tabIndex={0}
          aria-label={texts.playhead}
          aria-valuemin={0}
          aria-valuemax={last}
          aria-valuenow={time_s}
          aria-valuetext={texts.seconds(time_s)}
          data-testid="kf-playhead"
          style={at(time_s)}
          onKeyDown={(event) => {
            const step = stepOf(event);
            if (step === null) return;
            event.preventDefault();
            editor.scrub(Math.min(last, Math.max(0, time_s + step)));
          }}
        />
      </div>
    </div>
  );
}

interface MarkerProps {
  editor: Editor;
  index: number;
  one: Keyframe;
  invalid: boolean;
  style: Record<string, string>;
  timeAt: (clientX: number) => number;
}

function Marker({ editor, index, one, invalid, style, timeAt }: MarkerProps) {
  const dragged = useRef(false);
  const selected = editor.selected.value === index;
  const actions = ACTION_KINDS.filter((kind) => one[kind] !== undefined);
  const move = (time: number, gesture = ""): void => editor.change(setTime(editor.movement.value, index, time, false), gesture);
  return (
    <div
      class={`kf-marker ${selected ? "selected" : ""} ${invalid ? "invalid" : ""}`}
      style={style}
      role="slider"
      tabIndex={0}
      aria-label={texts.marker(index + 1, invalid)}
      aria-valuemin={0}
      aria-valuemax={600}
      aria-valuenow={one.time_s}
      aria-valuetext={texts.seconds(one.time_s)}
      aria-current={selected}
      data-testid={`kf-marker-${index + 1}`}
      data-time={one.time_s}
      onFocus={() => editor.select(index)}
      onPointerDown={(event) => {
        event.currentTarget.setPointerCapture(event.pointerId);
        dragged.current = false;
        editor.select(index);
      }}
      onPointerMove={(event) => {
        if (!event.currentTarget.hasPointerCapture(event.pointerId) || index === 0) return;
        const time = timeAt(event.clientX);
        // A click without motion does not move the keyframe.
        if (!dragged.current && Math.abs(time - one.time_s) < MIN_INTERVAL_S) return;
        dragged.current = true;
        move(time, `time-${index}`);
      }}
      onPointerUp={() => editor.endGesture()}
      onKeyDown={(event) => {
        if (event.key === "Delete") {
          event.preventDefault();
          editor.deleteSelected();
          return;
        }
        const step = stepOf(event);
        if (step === null) return;
        event.preventDefault();
        move(one.time_s + step);
      }}
    >
      <span class="kf-diamond" aria-hidden="true" />
      <span class="kf-number" aria-hidden="true">
        {index + 1}
      </span>
      {actions.length > 0 && (
        <span class="kf-action-mark" aria-hidden="true">
          {texts.actionMark}
        </span>
      )}
    </div>
  );
}

/** The time step of a key [s]; `null` for other keys. */
function stepOf(event: KeyboardEvent): number | null {
  const size = event.shiftKey ? 1 : event.altKey ? 0.01 : 0.1;
  if (event.key === "ArrowRight" || event.key === "ArrowUp") return size;
  if (event.key === "ArrowLeft" || event.key === "ArrowDown") return -size;
  return null;
}

/** All problems, each with its fix. */
export function ProblemList({ editor }: { editor: Editor }) {
  const found = editor.problems.value;
  const fast = found.filter(({ what }) => what.kind === "too-fast").length;
  const labels = new Map(editor.robot.joints.map(({ name, label }) => [name, label]));
  return (
    <Card title={texts.checks} class="kf-problems" aside={<span class="quiet">{texts.checked(found.length)}</span>}>
      <div role="status" data-testid="kf-problems" data-count={found.length}>
        {found.length === 0 && <p class="kf-valid">{texts.noProblems}</p>}
        {found.length > 0 && (
          <ul class="kf-list">
            {found.slice(0, 12).map((problem, index) => (
              <li key={index} class={`notice ${problem.severity === "error" ? "bad" : "warn"}`} data-testid={`kf-problem-${problem.what.kind}`}>
                <button type="button" class="plain" onClick={() => editor.select(problem.keyframe)}>
                  {texts.at(problem.keyframe + 1)}
                </button>
                <span>{texts.problem(problem, problem.joint === null ? "" : (labels.get(problem.joint) ?? problem.joint))}</span>
                {problem.fix !== null && (
                  <button
                    type="button"
                    data-testid="kf-fix"
                    onClick={() => {
                      const next = problem.fix?.(editor.movement.value);
                      if (next !== undefined) editor.change(next);
                    }}
                  >
                    {texts.fix(problem)}
                  </button>
                )}
              </li>
            ))}
          </ul>
        )}
        {found.length > 12 && <p class="quiet">{texts.more(found.length - 12)}</p>}
      </div>
      {fast > 1 && (
        <button
          type="button"
          data-testid="kf-fix-all"
          onClick={() => editor.change(stretchAll(editor.movement.value, editor.robot))}
        >
          {texts.fixAll}
        </button>
      )}
      <p class="quiet small">{texts.robotChecks}</p>
    </Card>
  );
}
