import { frameStream, unavailableReason, useFrames } from "../devices";
import type { DeviceStore } from "../devices/model";
import type { Values } from "../spaces/model";
import { Age } from "../../shared/ui/age";
import { Card } from "../../shared/ui/card";
import { useEffect, useRef, useState } from "preact/hooks";
import { sentence } from "../../shared/api/http";
import { useVisible } from "../../shared/hooks/use-visible";
import { clock, now } from "../../shared/lib/clock";
import { scanView } from "./model/live-view";
import type { RoomDeviceAction } from "./model/room-device-action";
import { readScan, type LidarScan } from "../../shared/mqtt/sensor-frames";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { canvasBox } from "../../shared/ui/hidpi-canvas";
import { contentOf } from "./use-capture-content";
import { colour, onColourChange } from "../../shared/ui/canvas-theme";

const RANGE = "range";
const LABEL_PX = 12;

interface CapturedScan {
  scan: LidarScan;
  at: number;
}

/** Lidar view to scale: live nearest distances per sector, and all beams, live or of a captured scan. */
export function LidarCard({ device, roomAction }: { device: DeviceStore; roomAction: RoomDeviceAction | null }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const [captured, setCaptured] = useState<CapturedScan | null>(null);
  const [error, setError] = useState("");
  const [repaint, setRepaint] = useState(0);
  const newest = device.measured(RANGE).value;
  const sectors = sectorsOf(newest?.message.values ?? {});
  const stream = frameStream(device, "scan");
  const frames = useFrames(device, "scan", stream?.name ?? null, useVisible(canvas) && captured === null, readScan);
  const { dots, old } = scanView(
    captured !== null,
    stream === null ? null : { latest: frames.latest, rateHz: stream.rate_hz },
    newest === null ? null : device.late(RANGE),
    clock.value,
  );
  const live = dots === "live" ? frames.latest : null;
  const scan = captured?.scan ?? live?.value ?? null;

  useEffect(() => onColourChange(() => setRepaint((count) => count + 1)), []);
  useEffect(() => {
    if (canvas.current === null) return;
    return canvasBox(canvas.current, (context, width, height) => draw(context, width, height, sectors, scan));
  }, [newest, scan, repaint]);

  const capture = async (): Promise<void> => {
    const found = await roomAction?.capture("scan");
    if (found === null || found === undefined) return;
    try {
      const scan = readScan(await contentOf(found));
      setCaptured({ scan, at: now() });
      setError("");
    } catch (error) {
      setError(sentence(error));
    }
  };

  const ranges = (scan?.range_m ?? []).filter((m) => m !== null);
  const nearest = sectors.length > 0 ? Math.min(...sectors) : ranges.length > 0 ? Math.min(...ranges) : null;
  const unavailable = unavailableReason(device);
  return (
    <Card
      title={texts.scan.title}
      class="picture"
      aside={
        nearest !== null && (
          <span class={`quiet ${old ? "old" : ""}`}>
            {texts.scan.nearest} <strong class="value">{texts.depth.read(nearest.toFixed(2))}</strong>
          </span>
        )
      }
    >
      <div class={`canvas-box scan-box ${old ? "old" : ""}`}>
        <canvas
          ref={canvas}
          role="img"
          data-testid="scan"
          data-beams={scan?.range_m.length ?? 0}
          data-sequence={live?.sequence ?? ""}
          aria-label={nearest === null ? texts.scan.labelEmpty : texts.scan.label(nearest.toFixed(2))}
        />
      </div>
      <p class="quiet small">
        {sectors.length > 0 && `${texts.scan.live} `}
        {captured !== null && <Age at={captured.at} as={(age) => texts.scan.points(captured.scan.range_m.length, age)} />}
        {live !== null && texts.scan.beams(live.value.range_m.length, format.oneDigit(live.rateHz))}
        {dots === "waiting" && texts.scan.waiting}
        {dots === "stalled" && frames.latest !== null && <Age at={frames.latest.at} as={texts.scan.stalled} />}
        {dots === "none" && roomAction !== null && texts.scan.noPoints}
        {old && newest !== null && <Age at={newest.receivedAt} as={(age) => ` ${texts.room.late(age)}`} />}
      </p>
      {roomAction !== null && (
        <div class="row">
          <button
            type="button"
            class="primary"
            data-testid="scan-shot"
            disabled={unavailable !== "" || roomAction.busy.value !== null}
            title={unavailable}
            onClick={() => void capture()}
          >
            {roomAction.busy.value === "capture" ? texts.camera.taking : texts.scan.shot}
          </button>
          {captured !== null && stream !== null && (
            <button type="button" data-testid="scan-live" onClick={() => setCaptured(null)}>
              {texts.scan.showLive}
            </button>
          )}
        </div>
      )}
      {roomAction !== null && roomAction.error.value !== "" && <p class="notice bad">{roomAction.error.value}</p>}
      {[error, captured === null ? frames.error : ""].map((message) => message !== "" && <p class="notice bad">{message}</p>)}
    </Card>
  );
}

/** `range_m.0`, `range_m.1` …: the nearest distance in each sector, counted from the x axis. */
function sectorsOf(values: Values): number[] {
  const found: number[] = [];
  for (let index = 0; typeof values[`range_m.${index}`] === "number"; index += 1) found.push(Number(values[`range_m.${index}`]));
  return found;
}

/** Top view: x axis up, counter-clockwise to the left. Scaled to the largest distance. */
function draw(context: CanvasRenderingContext2D, width: number, height: number, sectors: number[], scan: LidarScan | null): void {
  const wide = (2 * Math.PI) / sectors.length;
  const beams = (scan?.range_m ?? []).flatMap((m, index) => (m === null ? [] : [pointAt(scan?.angle_rad[index] ?? 0, m)]));
  const arcs = sectors.flatMap((m, index) => [0, 0.5, 1].map((share) => pointAt((index + share) * wide, m)));
  const points = [[-0.5, -0.5], [0.5, 0.5], ...arcs, ...beams] as const;
  const [xs, ys] = [points.map(([right]) => right), points.map(([, up]) => up)];
  const [left, right, low, high] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const scale = Math.min((width - 4 * LABEL_PX) / (right - left), (height - 4 * LABEL_PX) / (high - low));
  const [x, y] = [width / 2 - ((left + right) / 2) * scale, height / 2 + ((low + high) / 2) * scale];
  paintRings(context, x, y, Math.ceil(Math.hypot(width, height) / scale), scale);

  context.fillStyle = colour("--series-1");
  context.strokeStyle = colour("--series-1");
  sectors.forEach((m, index) => {
    // Canvas angles run clockwise from the right; these counter-clockwise from the top.
    const [from, to] = [-Math.PI / 2 - (index + 1) * wide, -Math.PI / 2 - index * wide];
    context.globalAlpha = 0.12;
    context.beginPath();
    context.moveTo(x, y);
    context.arc(x, y, m * scale, from, to);
    context.fill();
    context.globalAlpha = 1;
    context.lineWidth = 2.5;
    context.beginPath();
    context.arc(x, y, m * scale, from, to);
    context.stroke();
  });

  context.fillStyle = colour("--series-2");
  for (const [right, up] of beams) context.fillRect(x + right * scale - 1.5, y - up * scale - 1.5, 3, 3);
  context.fillStyle = colour("--text");
  context.beginPath();
  context.arc(x, y, 4, 0, 2 * Math.PI);
  context.fill();
}

/** A point right of and above the lidar [m]. */
function pointAt(angle: number, m: number): readonly [number, number] {
  return [-Math.sin(angle) * m, Math.cos(angle) * m];
}

function paintRings(context: CanvasRenderingContext2D, x: number, y: number, rings: number, scale: number): void {
  context.strokeStyle = colour("--line-strong");
  context.fillStyle = colour("--quiet");
  context.lineWidth = 1;
  context.font = `${LABEL_PX}px system-ui, sans-serif`;
  // Every metre, unless the labels would overlap.
  const every = Math.max(1, Math.ceil(26 / scale));
  for (let ring = 1; ring <= rings; ring += 1) {
    context.globalAlpha = 0.35;
    context.beginPath();
    context.arc(x, y, ring * scale, 0, 2 * Math.PI);
    context.stroke();
    context.globalAlpha = 1;
    if (ring % every !== 0) continue;
    context.fillText(`${ring} m`, x + 4, y - ring * scale - 3);
    context.fillText(`${ring} m`, x + 4, y + ring * scale - 3);
  }
  context.globalAlpha = 0.35;
  for (let spoke = 0; spoke < 4; spoke += 1) {
    const angle = (spoke * Math.PI) / 2;
    context.beginPath();
    context.moveTo(x, y);
    context.lineTo(x + Math.cos(angle) * rings * scale, y + Math.sin(angle) * rings * scale);
    context.stroke();
  }
  context.globalAlpha = 1;
  context.textAlign = "right";
  context.fillText(`${texts.scan.ahead} ↑`, x - 6, y - scale * 0.5);
  context.textAlign = "left";
}
