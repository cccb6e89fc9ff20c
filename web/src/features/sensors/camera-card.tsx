import { unavailableReason } from "../devices";
import type { DeviceStore } from "../devices/model";
import { Age } from "../../shared/ui/age";
import { Card } from "../../shared/ui/card";
import type { ComponentChildren } from "preact";
import { useEffect, useRef, useState } from "preact/hooks";
import { sentence } from "../../shared/api/http";
import { clock, now } from "../../shared/lib/clock";
import type { CameraFrame } from "../../shared/mqtt/camera-frame";
import type { RoomDeviceAction } from "./model/room-device-action";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { contentOf } from "./use-capture-content";
import "./sensors.css";

/** Without a frame for this long, the image is not live [ms]; for a slow camera, three periods. */
const STALLED_MS = 2_000;
/** Averaging time of the frame rate [ms]. */
const RATE_OVER_MS = 3_000;

interface Shown {
  kind: "live" | "still";
  width: number;
  height: number;
  /** Arrival time on the page's clock [ms]. */
  at: number;
}

interface CameraCardProps {
  device: DeviceStore;
  name: string;
  /** Takes single pictures; `null` if unsupported. */
  roomAction: RoomDeviceAction | null;
  title?: string;
  aside?: ComponentChildren;
}

/** Draws camera frames on a canvas. The page subscribes only while the card is visible. */
export function CameraCard({ device, name, roomAction, title, aside }: CameraCardProps) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const [running, setRunning] = useState(false);
  const [shown, setShown] = useState<Shown | null>(null);
  const [rate, setRate] = useState(0);
  const [error, setError] = useState("");

  useEffect(() => {
    if (!running) return;
    const painter = new Painter(canvas, (frame, arrivals) => {
      setShown({ kind: "live", width: frame.width, height: frame.height, at: arrivals.at(-1) ?? now() });
      setRate(arrivals.length / Math.max(0.5, Math.min(RATE_OVER_MS, now() - (arrivals[0] ?? 0)) / 1000));
      setError("");
    }, () => setError(texts.camera.undecodable));
    const end = device.watchCamera(name, (frame) => painter.push(frame));
    return () => {
      end();
      painter.dispose();
    };
  }, [device, name, running]);

  const takeImage = async (): Promise<void> => {
    const taken = await roomAction?.capture("image");
    if (taken === null || taken === undefined || canvas.current === null) return;
    try {
      const image = await createImageBitmap(new Blob([await contentOf(taken)], { type: taken.upload.content_type }));
      paint(canvas.current, image);
      setRunning(false);
      setShown({ kind: "still", width: image.width, height: image.height, at: now() });
      image.close();
      setError("");
    } catch (error) {
      setError(sentence(error));
    }
  };

  const rateHz = device.description.value?.cameras.find((one) => one.name === name)?.rate_hz ?? 1;
  const silentMs = shown === null ? 0 : clock.value - shown.at;
  const stalled = running && shown?.kind === "live" && silentMs > Math.max(STALLED_MS, 3000 / rateHz);
  const old = stalled || (shown?.kind === "live" && !running) || !device.live.value;
  const unavailable = unavailableReason(device);
  return (
    <Card title={title ?? texts.camera.title(name)} class="picture" aside={aside}>
      <div class="canvas-box image-box">
        <canvas
          ref={canvas}
          role="img"
          aria-label={texts.camera.label(name)}
          class={old ? "old" : ""}
          data-testid="camera-picture"
          width={320}
          height={240}
        />
        {shown === null && <p class="over quiet">{running ? texts.camera.waiting : texts.camera.off}</p>}
        {stalled && (
          <p class="tag" role="status">
            <Age at={shown.at} as={texts.camera.stalled} />
          </p>
        )}
      </div>
      <div class="row">
        <button
          type="button"
          class={running ? "" : "primary"}
          data-testid="camera-live"
          aria-pressed={running}
          onClick={() => setRunning(!running)}
        >
          {running ? texts.camera.stop : texts.camera.start}
        </button>
        {roomAction !== null && (
          <button
            type="button"
            data-testid="camera-shot"
            disabled={unavailable !== "" || roomAction.busy.value !== null}
            title={unavailable}
            onClick={() => void takeImage()}
          >
            {roomAction.busy.value === "capture" ? texts.camera.taking : texts.camera.shot}
          </button>
        )}
        <span class="quiet small">{shown !== null && <Caption shown={shown} running={running} rate={rate} rateHz={rateHz} />}</span>
      </div>
      {roomAction !== null && roomAction.error.value !== "" && <p class="notice bad">{roomAction.error.value}</p>}
      {error !== "" && <p class="notice bad">{error}</p>}
    </Card>
  );
}

interface CaptionProps {
  shown: Shown;
  running: boolean;
  /** Measured rate [Hz]. */
  rate: number;
  /** Configured rate [Hz]. */
  rateHz: number;
}

function Caption({ shown, running, rate, rateHz }: CaptionProps) {
  const { kind, width, height, at } = shown;
  if (kind === "still") return <Age at={at} as={(age) => texts.camera.still(width, height, age)} />;
  if (!running) return <Age at={at} as={texts.camera.stopped} />;
  return <>{texts.camera.live(width, height, format.oneDigit(rate), format.upToOneDigit(rateHz))}</>;
}

/** Decodes one frame at a time and drops frames that arrive meanwhile, so that the newest is drawn. */
class Painter {
  readonly #canvas: { readonly current: HTMLCanvasElement | null };
  readonly #drawn: (frame: CameraFrame, arrivals: readonly number[]) => void;
  readonly #failed: () => void;
  #arrivals: number[] = [];
  #next: CameraFrame | null = null;
  #busy = false;
  #disposed = false;

  constructor(
    canvas: { readonly current: HTMLCanvasElement | null },
    drawn: (frame: CameraFrame, arrivals: readonly number[]) => void,
    failed: () => void,
  ) {
    this.#canvas = canvas;
    this.#drawn = drawn;
    this.#failed = failed;
  }

  push(frame: CameraFrame): void {
    const at = now();
    this.#arrivals = [...this.#arrivals.filter((one) => one > at - RATE_OVER_MS), at];
    this.#next = frame;
    if (!this.#busy) void this.#work();
  }

  dispose(): void {
    this.#disposed = true;
  }

  async #work(): Promise<void> {
    this.#busy = true;
    for (let frame = this.#next; frame !== null; frame = this.#next) {
      this.#next = null;
      try {
        const image = await createImageBitmap(new Blob([frame.jpeg.slice()], { type: "image/jpeg" }));
        const canvas = this.#canvas.current;
        if (!this.#disposed && canvas !== null) {
          paint(canvas, image);
          canvas.setAttribute("data-sequence", String(frame.sequence));
          this.#drawn(frame, this.#arrivals);
        }
        image.close();
      } catch {
        if (!this.#disposed) this.#failed();
      }
    }
    this.#busy = false;
  }
}

function paint(canvas: HTMLCanvasElement, image: ImageBitmap): void {
  if (canvas.width !== image.width) canvas.width = image.width;
  if (canvas.height !== image.height) canvas.height = image.height;
  canvas.getContext("2d")?.drawImage(image, 0, 0);
}
