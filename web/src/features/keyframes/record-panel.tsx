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
const MOST_POINTS = 300;

export function RecordPanel({ device, editor }: RecordProps) {
  const recorder = useMemo(() => new Recorder(), []);
  const running = recorder.running.value;
  const take = recorder.take.value;
  useEffect(() => {
    const ends = [
      effect(() => {
        const newest = device.telemetry.value;
        if (newest !== null) recorder.hear(newest.message);
      }),
      effect(() => {
        for (const event of device.events.value.slice(0, 1)) recorder.hearEvent(event);
      }),
    ];
    return () => {
      for (const end of ends) end();
    };
  }, [recorder, device]);
  const lasts = take.samples.at(-1)?.time_s ?? 0;
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
        <span role="status" class="quiet" data-testid="kf-recorded" data-samples={take.samples.length}>
          {take.samples.length > 0 && texts.recorded(take.samples.length, lasts, take.gaps.length)}
        </span>
      </div>
      {!running && take.samples.length > 1 && (
        <Trim key={lasts} take={take} lasts={lasts} editor={editor} onDone={() => recorder.forget()} />
      )}
    </Card>
  );
}

interface TrimProps {
  take: Recording;
  lasts: number;
  editor: Editor;
  onDone: () => void;
}

function Trim({ take, lasts, editor, onDone }: TrimProps) {
  const [from, setFrom] = useState(0);
  const [to, setTo] = useState(lasts);
  const [tolerance, setTolerance] = useState(2);
  const made = useMemo(
    () => keyframesOf(trim(take, from, to), radians(tolerance), editor.robot),
    [take, from, to, tolerance, editor],
  );
  const use = (): void => {
    editor.change({ ...editor.movement.value, keyframes: made });
    editor.choose(0);
    onDone();
  };
  return (
    <>
      <Curves take={take} lasts={lasts} from={from} to={to} made={made} editor={editor} />
      <div class="kf-trim">
        <Handle id="kf-from" label={texts.trimFrom} value={from} most={lasts} onSet={(value) => setFrom(Math.min(value, to - 0.1))} />
        <Handle id="kf-to" label={texts.trimTo} value={to} most={lasts} onSet={(value) => setTo(Math.max(value, from + 0.1))} />
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
        <button type="button" class="primary" data-testid="kf-use" disabled={made.length < 2} onClick={use}>
          {texts.useThem(made.length)}
        </button>
        <button type="button" class="plain" onClick={onDone}>
          {texts.discard}
        </button>
      </div>
      {take.gaps.length > 0 && <p class="notice warn">{texts.gapNote}</p>}
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
  take: Recording;
  lasts: number;
  from: number;
  to: number;
  made: readonly Keyframe[];
  editor: Editor;
}

/** Each joint within its range, gaps, trimmed parts and the resulting keyframes. */
function Curves({ take, lasts, from, to, made, editor }: CurvesProps) {
  const x = (time: number): number => (time / lasts) * WIDTH;
  const lines = useMemo(() => {
    const every = Math.max(1, Math.floor(take.samples.length / MOST_POINTS));
    const some = take.samples.filter((_, index) => index % every === 0);
    return editor.robot.joints.flatMap((_, index) => {
      const places = some.map(({ position_rad }) => position_rad[index] ?? 0);
      const [low, high] = [Math.min(...places), Math.max(...places)];
      if (degrees(high - low) < 0.5) return [];
      const y = (place: number): number => HEIGHT - 8 - ((place - low) / (high - low)) * (HEIGHT - 16);
      return [{ index, points: some.map(({ time_s }, at) => `${x(time_s).toFixed(1)},${y(places[at] ?? 0).toFixed(1)}`).join(" ") }];
    });
  }, [take]);
  return (
    <svg class="kf-curves" viewBox={`0 0 ${WIDTH} ${HEIGHT}`} preserveAspectRatio="none" role="img" aria-label={texts.curves(lines.length)}>
      {take.gaps.map((gap) => (
        <rect key={gap.from_s} class="gap" x={x(gap.from_s)} width={x(gap.to_s - gap.from_s)} y={0} height={HEIGHT} />
      ))}
      {lines.map(({ index, points }) => (
        <polyline key={index} class={`series-${(index % 8) + 1}`} points={points} />
      ))}
      {made.map((one) => (
        <line key={one.time_s} class="key" x1={x(one.time_s + from)} x2={x(one.time_s + from)} y1={0} y2={HEIGHT} />
      ))}
      <rect class="cut" x={0} width={x(from)} y={0} height={HEIGHT} />
      <rect class="cut" x={x(to)} width={Math.max(0, WIDTH - x(to))} y={0} height={HEIGHT} />
    </svg>
  );
}
