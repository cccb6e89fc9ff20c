import { unavailableReason } from "../devices";
import { type DeviceStore, followFrames } from "../devices/model";
import { Age } from "../../shared/ui/age";
import { Card } from "../../shared/ui/card";
import type { ComponentChildren } from "preact";
import { useEffect, useRef, useState } from "preact/hooks";
import { sentence } from "../../shared/api/http";
import { lateAfterMs } from "../../shared/lib/arrivals";
import { clock, now } from "../../shared/lib/clock";
import type { RoomDeviceAction } from "./model/room-device-action";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { contentOf } from "./use-capture-content";
import "./sensors.css";

interface Shown {
  kind: "live" | "still";
  width: number;
  height: number;
  /** Arrival time on the page's clock [ms]. */
  at: number;
  /** Observed period of the stream [ms]; `null` if not known. */
  everyMs: number | null;
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
    let ended = false;
    const drawn = async (content: Uint8Array): Promise<{ width: number; height: number }> => {
      const image = await createImageBitmap(new Blob([content.slice()], { type: "image/jpeg" }));
      const { width, height } = image;
      // A frame that is decoded after the end must not replace a still image.
      if (!ended && canvas.current !== null) paint(canvas.current, image);
      image.close();
      return { width, height };
    };
    const end = followFrames(device, name, "colour", drawn, ({ latest, error }) => {
      setError(error === "" ? "" : texts.camera.undecodable);
      if (latest === null) return;
      canvas.current?.setAttribute("data-sequence", String(latest.sequence));
      setShown({ kind: "live", ...latest.value, at: latest.at, everyMs: latest.everyMs });
      setRate(latest.rateHz);
    });
    return () => {
      ended = true;
      end();
    };
  }, [device, name, running]);

  const takeImage = async (): Promise<void> => {
    const taken = await roomAction?.capture("image");
    if (taken === null || taken === undefined || canvas.current === null) return;
    try {
      const image = await createImageBitmap(new Blob([await contentOf(taken)], { type: taken.upload.content_type }));
      paint(canvas.current, image);
      setRunning(false);
      setShown({ kind: "still", width: image.width, height: image.height, at: now(), everyMs: null });
      image.close();
      setError("");
    } catch (error) {
      setError(sentence(error));
    }
  };

  const rateHz = device.description.value?.cameras.find((one) => one.name === name)?.rate_hz ?? 1;
  const silentMs = shown === null ? 0 : clock.value - shown.at;
  const stalled = running && shown?.kind === "live" && silentMs > lateAfterMs(rateHz, shown.everyMs);
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

function paint(canvas: HTMLCanvasElement, image: ImageBitmap): void {
  if (canvas.width !== image.width) canvas.width = image.width;
  if (canvas.height !== image.height) canvas.height = image.height;
  canvas.getContext("2d")?.drawImage(image, 0, 0);
}
