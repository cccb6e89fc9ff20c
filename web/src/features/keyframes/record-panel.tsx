/** Records the robot's motion from any source, trims both ends and converts it to keyframes. */
import type { DeviceStore } from "../devices/model";
import { Card } from "../../shared/ui/card";
import { effect } from "@preact/signals";
import { useEffect, useMemo, useState } from "preact/hooks";
import { degrees, radians } from "../../shared/lib/angles";
import type { Editor } from "./model/editor";
import type { Keyframe } from "./model/keyframes";
import { keyframesOf, Recorder, trim, type Recording } from "./model/recording";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";

interface RecordProps {
  device: DeviceStore;
  editor: Editor;
}

const [WIDTH, HEIGHT] = [600, 120];
const MAX_POINTS = 300;

export function RecordPanel({ device, editor }: RecordProps) {
  const recorder = useMemo(() => new Recorder(), []);
  const running = recorder.running.value;
  const recording = recorder.recording.value;
  useEffect(() => {
    const disposers = [
      effect(() => {
        const newest = device.telemetry.value;
        if (newest !== null) recorder.addTelemetry(newest.message);
      }),
      effect(() => {
        for (const event of device.events.value.slice(0, 1)) recorder.addEvent(event);
      }),
    ];
    return () => {
      for (const dispose of disposers) dispose();
    };
  }, [recorder, device]);
  const duration_s = recording.samples.at(-1)?.time_s ?? 0;
  return (
    <Card title={texts.record} class="kf-record">
      <p class="quiet small">{texts.recordNote}</p>
      <div class="row">
        <button
          type="button"
          data-testid="kf-record"
          aria-pressed={running}
          disabled={!running && !device.live.value}
          onClick={() => (running ? recorder.stop() : recorder.start())}
        >
          {running ? texts.stopRecording : texts.startRecording}
        </button>
        {running && !device.live.value && <span class="notice warn">{texts.recordingGap}</span>}
        <span role="status" class="quiet" data-testid="kf-recorded" data-samples={recording.samples.length}>
          {recording.samples.length > 0 && texts.recorded(recording.samples.length, duration_s, recording.gaps.length)}
        </span>
      </div>
      {!running && recording.samples.length > 1 && (
        <Trim key={duration_s} recording={recording} duration_s={duration_s} editor={editor} onDone={() => recorder.clear()} />
      )}
    </Card>
  );
}

interface TrimProps {
  recording: Recording;
  duration_s: number;
  editor: Editor;
  onDone: () => void;
}

function Trim({ recording, duration_s, editor, onDone }: TrimProps) {
  const [from, setFrom] = useState(0);
  const [to, setTo] = useState(duration_s);
  const [tolerance, setTolerance] = useState(2);
  const keyframes = useMemo(
    () => keyframesOf(trim(recording, from, to), radians(tolerance), editor.robot),
    [recording, from, to, tolerance, editor],
  );
  const apply = (): void => {
    editor.change({ ...editor.movement.value, keyframes });
    editor.select(0);
    onDone();
  };
  return (
    <>
      <Curves recording={recording} duration_s={duration_s} from={from} to={to} keyframes={keyframes} editor={editor} />
      <div class="kf-trim">
        <Handle id="kf-from" label={texts.trimFrom} value={from} most={duration_s} onSet={(value) => setFrom(Math.min(value, to - 0.1))} />
        <Handle id="kf-to" label={texts.trimTo} value={to} most={duration_s} onSet={(value) => setTo(Math.max(value, from + 0.1))} />
        <label for="kf-tolerance">{texts.tolerance}</label>
        <input
          id="kf-tolerance"
          type="range"
          min={0.25}
          max={10}
          step={0.25}
          value={tolerance}
          data-testid="kf-tolerance"
          aria-valuetext={format.degrees(tolerance)}
          onInput={(event) => setTolerance(event.currentTarget.valueAsNumber)}
        />
        <output for="kf-tolerance">{format.degrees(tolerance)}</output>
      </div>
      <div class="row">
        <button type="button" class="primary" data-testid="kf-use" disabled={keyframes.length < 2} onClick={apply}>
          {texts.useKeyframes(keyframes.length)}
        </button>
        <button type="button" class="plain" onClick={onDone}>
          {texts.discard}
        </button>
      </div>
      {recording.gaps.length > 0 && <p class="notice warn">{texts.gapNote}</p>}
    </>
  );
}

interface HandleProps {
  id: string;
  label: string;
  value: number;
  most: number;
  onSet: (value: number) => void;
}

function Handle({ id, label, value, most, onSet }: HandleProps) {
  return (
    <>
      <label for={id}>{label}</label>
      <input
        id={id}
        type="range"
        min={0}
        max={most}
        step={0.05}
        value={value}
        data-testid={id}
        aria-valuetext={texts.seconds(value)}
        onInput={(event) => onSet(event.currentTarget.valueAsNumber)}
      />
      <output for={id}>{texts.seconds(value)}</output>
    </>
  );
}

interface CurvesProps {
  recording: Recording;
  duration_s: number;
  from: number;
  to: number;
  keyframes: readonly Keyframe[];
  editor: Editor;
}

/** Each joint within its range, gaps, trimmed parts and the resulting keyframes. */
function Curves({ recording, duration_s, from, to, keyframes, editor }: CurvesProps) {
  const x = (time: number): number => (time / duration_s) * WIDTH;
  const lines = useMemo(() => {
    const every = Math.max(1, Math.floor(recording.samples.length / MAX_POINTS));
    const samples = recording.samples.filter((_, index) => index % every === 0);
    return editor.robot.joints.flatMap((_, index) => {
      const positions = samples.map(({ position_rad }) => position_rad[index] ?? 0);
      const [low, high] = [Math.min(...positions), Math.max(...positions)];
      if (degrees(high - low) < 0.5) return [];
      const y = (position: number): number => HEIGHT - 8 - ((position - low) / (high - low)) * (HEIGHT - 16);
      return [{ index, points: samples.map(({ time_s }, at) => `${x(time_s).toFixed(1)},${y(positions[at] ?? 0).toFixed(1)}`).join(" ") }];
    });
  }, [recording]);
  return (
    <svg class="kf-curves" viewBox={`0 0 ${WIDTH} ${HEIGHT}`} preserveAspectRatio="none" role="img" aria-label={texts.curves(lines.length)}>
      {recording.gaps.map((gap) => (
        <rect key={gap.from_s} class="gap" x={x(gap.from_s)} width={x(gap.to_s - gap.from_s)} y={0} height={HEIGHT} />
      ))}
      {lines.map(({ index, points }) => (
        <polyline key={index} class={`series-${(index % 8) + 1}`} points={points} />
      ))}
      {keyframes.map((one) => (
        <line key={one.time_s} class="key" x1={x(one.time_s + from)} x2={x(one.time_s + from)} y1={0} y2={HEIGHT} />
      ))}
      <rect class="cut" x={0} width={x(from)} y={0} height={HEIGHT} />
      <rect class="cut" x={x(to)} width={Math.max(0, WIDTH - x(to))} y={0} height={HEIGHT} />
    </svg>
  );
}
