/** The timeline: keyframe markers, moved by dragging or keys, and the preview's playhead. */
import { stretchAll } from "./model/problems";
import { Card } from "../../shared/ui/card";
import { useRef } from "preact/hooks";
import type { Editor } from "./model/editor";
import { ACTION_KINDS, setTime, SHORTEST_S, type Keyframe, type Positions } from "./model/keyframes";
import { texts } from "./texts";

interface TimelineProps {
  editor: Editor;
  measured: Positions | null;
}

const TICKS = [0.25, 0.5, 1, 2, 5, 10, 20, 60, 120];
const MOST_TICKS = 9;

export function Timeline({ editor, measured }: TimelineProps) {
  const playing = editor.playing.value;
  const { keyframes } = editor.movement.value;
  const asked = editor.plan.value.asked(editor.at.value);
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
          {texts.ofSeconds(asked, last)}
        </span>
        <span class="quiet small">{texts.previewOnly}</span>
      </div>
      <Track editor={editor} asked={asked} last={last} />
      <div class="row kf-actions">
        <button type="button" data-testid="kf-add" onClick={() => editor.add(editor.poseAtKeyframe(editor.chosen.value))}>
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
        <button type="button" data-testid="kf-duplicate" onClick={() => editor.copy()}>
          {texts.duplicate}
        </button>
        <button type="button" data-testid="kf-delete" disabled={keyframes.length < 2} onClick={() => editor.drop()}>
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

function Track({ editor, asked, last }: { editor: Editor; asked: number; last: number }) {
  const track = useRef<HTMLDivElement>(null);
  const span = Math.max(2, last * 1.06);
  const { keyframes } = editor.movement.value;
  const wrong = new Set(editor.problems.value.map(({ keyframe }) => keyframe));
  const fast = new Set(editor.problems.value.flatMap(({ keyframe, what }) => (what.kind === "too-fast" ? [keyframe] : [])));
  const every = TICKS.find((step) => span / step <= MOST_TICKS) ?? 120;
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
              class={`kf-stretch ${fast.has(index + 1) ? "fast" : ""}`}
              style={{ ...at(keyframes[index]?.time_s ?? 0), "--to": String(one.time_s / span) }}
            />
          ))}
        </div>
        {keyframes.map((one, index) => (
          <Marker key={index} editor={editor} index={index} one={one} wrong={wrong.has(index)} style={at(one.time_s)} timeAt={timeAt} />
        ))}
        <div
          class="kf-playhead"
          role="slider"
          tabIndex={0}
          aria-label={texts.playhead}
          aria-valuemin={0}
          aria-valuemax={last}
          aria-valuenow={asked}
          aria-valuetext={texts.seconds(asked)}
          data-testid="kf-playhead"
          style={at(asked)}
          onKeyDown={(event) => {
            const step = stepOf(event);
            if (step === null) return;
            event.preventDefault();
            editor.scrub(Math.min(last, Math.max(0, asked + step)));
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
  wrong: boolean;
  style: Record<string, string>;
  timeAt: (clientX: number) => number;
}

function Marker({ editor, index, one, wrong, style, timeAt }: MarkerProps) {
  const dragged = useRef(false);
  const chosen = editor.chosen.value === index;
  const done = ACTION_KINDS.filter((deed) => one[deed] !== undefined);
  const move = (time: number, gesture = ""): void => editor.change(setTime(editor.movement.value, index, time, false), gesture);
  return (
    <div
      class={`kf-marker ${chosen ? "chosen" : ""} ${wrong ? "wrong" : ""}`}
      style={style}
      role="slider"
      tabIndex={0}
      aria-label={texts.marker(index + 1, wrong)}
      aria-valuemin={0}
      aria-valuemax={600}
      aria-valuenow={one.time_s}
      aria-valuetext={texts.seconds(one.time_s)}
      aria-current={chosen}
      data-testid={`kf-marker-${index + 1}`}
      data-time={one.time_s}
      onFocus={() => editor.choose(index)}
      onPointerDown={(event) => {
        event.currentTarget.setPointerCapture(event.pointerId);
        dragged.current = false;
        editor.choose(index);
      }}
      onPointerMove={(event) => {
        if (!event.currentTarget.hasPointerCapture(event.pointerId) || index === 0) return;
        const time = timeAt(event.clientX);
        // A touch without motion does not move it.
        if (!dragged.current && Math.abs(time - one.time_s) < SHORTEST_S) return;
        dragged.current = true;
        move(time, `time-${index}`);
      }}
      onPointerUp={() => editor.settle()}
      onKeyDown={(event) => {
        if (event.key === "Delete") {
          event.preventDefault();
          editor.drop();
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
      {done.length > 0 && (
        <span class="kf-does" aria-hidden="true">
          {texts.deedMark}
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

/** All problems, each with its remedy. */
export function ProblemList({ editor }: { editor: Editor }) {
  const found = editor.problems.value;
  const fast = found.filter(({ what }) => what.kind === "too-fast").length;
  const labels = new Map(editor.robot.joints.map(({ name, label }) => [name, label]));
  return (
    <Card title={texts.checks} class="kf-problems" aside={<span class="quiet">{texts.checked(found.length)}</span>}>
      <div role="status" data-testid="kf-problems" data-count={found.length}>
        {found.length === 0 && <p class="kf-good">{texts.allGood}</p>}
        {found.length > 0 && (
          <ul class="kf-list">
            {found.slice(0, 12).map((problem, index) => (
              <li key={index} class={`notice ${problem.severity === "error" ? "bad" : "warn"}`} data-testid={`kf-problem-${problem.what.kind}`}>
                <button type="button" class="plain" onClick={() => editor.choose(problem.keyframe)}>
                  {texts.at(problem.keyframe + 1)}
                </button>
                <span>{texts.problem(problem, problem.joint === null ? "" : (labels.get(problem.joint) ?? problem.joint))}</span>
                {problem.mend !== null && (
                  <button
                    type="button"
                    data-testid="kf-mend"
                    onClick={() => {
                      const next = problem.mend?.(editor.movement.value);
                      if (next !== undefined) editor.change(next);
                    }}
                  >
                    {texts.mend(problem)}
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
          data-testid="kf-mend-all"
          onClick={() => editor.change(stretchAll(editor.movement.value, editor.robot))}
        >
          {texts.mendAll}
        </button>
      )}
      <p class="quiet small">{texts.robotChecks}</p>
    </Card>
  );
}
