import { frameStream, unavailableReason, useFrames } from "../devices";
import type { DeviceStore, LatestFrame } from "../devices/model";
import { Age } from "../../shared/ui/age";
import { Card } from "../../shared/ui/card";
import { useMemo, useRef, useState } from "preact/hooks";
import { sentence } from "../../shared/api/http";
import { useVisible } from "../../shared/hooks/use-visible";
import { clock, now } from "../../shared/lib/clock";
import { readDepth, type DepthImage } from "../../shared/lib/png";
import { readPeople } from "../../shared/mqtt/sensor-frames";
import type { RoomDeviceAction } from "./model/room-device-action";
import { scaleOf, type DepthScale } from "./model/depth-scale";
import { depthView } from "./model/live-view";
import { format } from "../../shared/i18n/format";
import { DepthPicture, Skeletons } from "./depth-picture";
import { texts } from "./texts";
import { contentOf } from "./use-capture-content";

interface DepthCardProps {
  device: DeviceStore;
  /** Takes single images; `null` if unsupported. */
  roomAction: RoomDeviceAction | null;
}

interface Captured {
  image: DepthImage;
  at: number;
}

/** Depth image and tracked people: near is dark, far is light, out of range is grey. The page subscribes while visible. */
export function DepthCard({ device, roomAction }: DepthCardProps) {
  const box = useRef<HTMLDivElement>(null);
  const visible = useVisible(box);
  const [running, setRunning] = useState(false);
  const [captured, setCaptured] = useState<Captured | null>(null);
  const [error, setError] = useState("");
  const [depth, people] = [frameStream(device, "depth"), frameStream(device, "people")];
  const active = running && visible;
  const live = useFrames(device, "depth", depth?.name ?? null, active, readDepth);
  const tracked = useFrames(device, "people", people?.name ?? null, active, readPeople);

  // The last image stays after the end of the subscription, marked as old and with its age.
  const last = useRef<LatestFrame<DepthImage> | null>(null);
  last.current = live.latest ?? last.current;
  const image = last.current;
  const shown = captured ?? (image === null ? null : { image: image.value, at: image.at });
  const scale = useScale(shown?.image ?? null, captured === null);
  const latest = depth === null ? tracked.latest : image;
  const { stalled, overlay } = depthView(
    running && captured === null,
    depth === null ? null : { latest: image, rateHz: depth.rate_hz },
    people === null ? null : { latest: tracked.latest, rateHz: people.rate_hz },
    clock.value,
  );
  const old = stalled || !device.live.value || (latest !== null && captured === null && !running);

  const capture = async (): Promise<void> => {
    const file = await roomAction?.capture("depth");
    if (file === null || file === undefined) return;
    try {
      setCaptured({ image: await readDepth(await contentOf(file)), at: now() });
      setRunning(false);
      setError("");
    } catch (error) {
      setError(sentence(error));
    }
  };
  const toggle = (): void => {
    setCaptured(null);
    setRunning(!running);
  };

  const unavailable = unavailableReason(device);
  const busy = roomAction !== null && roomAction.busy.value !== null;
  const messages = [roomAction?.error.value ?? "", error, running ? live.error : "", running ? tracked.error : ""].filter((one) => one !== "");
  const caption = (age: string): string => {
    if (shown === null) return "";
    const { width, height } = shown.image;
    return (captured === null ? texts.depth.received : texts.depth.captured)(width, height, age);
  };
  return (
    <Card title={depth === null && people !== null ? texts.people.title : texts.depth.title} class="picture">
      <div ref={box} class={`depth-box ${old ? "old" : ""}`}>
        {shown !== null && scale !== null ? (
          <DepthPicture drawn={{ image: shown.image, scale, sequence: image?.sequence ?? 0 }} people={overlay} />
        ) : overlay !== null && depth === null ? (
          <div class="depth-picture people-only">
            <Skeletons people={overlay} width={320} height={240} />
          </div>
        ) : (
          <p class="over quiet">{running ? texts.depth.waiting : depth === null && people === null ? texts.depth.none : texts.depth.off}</p>
        )}
        {stalled && latest !== null && (
          <p class="tag" role="status">
            <Age at={latest.at} as={texts.camera.stalled} />
          </p>
        )}
      </div>
      {shown !== null && (
        <p class="quiet small">
          {texts.depth.hint} {texts.depth.noReading}
        </p>
      )}
      {people !== null && (
        <p class="small" role="status" data-testid="tracked-people" data-people={overlay?.people.length ?? ""}>
          {overlay === null ? <span class="quiet">{texts.people.key}</span> : texts.people.count(overlay.people.length)}
          {overlay !== null && overlay.people.length > 0 && <span class="quiet"> {texts.people.key}</span>}
        </p>
      )}
      <div class="row">
        {(depth !== null || people !== null) && (
          <button type="button" class={running ? "" : "primary"} data-testid="depth-live" aria-pressed={running} onClick={toggle}>
            {running ? texts.depth.stop : texts.depth.start}
          </button>
        )}
        {roomAction !== null && (
          <button
            type="button"
            class={depth === null ? "primary" : ""}
            data-testid="depth-shot"
            disabled={unavailable !== "" || busy}
            title={unavailable}
            onClick={() => void capture()}
          >
            {busy ? texts.camera.taking : captured === null ? texts.depth.shot : texts.depth.again}
          </button>
        )}
        <span class="quiet small">
          {running && live.latest !== null && !stalled
            ? texts.camera.live(live.latest.value.width, live.latest.value.height, format.oneDigit(live.latest.rateHz), format.upToOneDigit(depth?.rate_hz ?? 0))
            : shown !== null && <Age at={shown.at} as={caption} />}
        </span>
      </div>
      {messages.map((message) => (
        <p key={message} class="notice bad">
          {message}
        </p>
      ))}
    </Card>
  );
}

/** The colour scale of an image; that of a live image follows the previous one. */
function useScale(image: DepthImage | null, live: boolean): DepthScale | null {
  const previous = useRef<DepthScale | null>(null);
  return useMemo(() => {
    if (image === null) return null;
    previous.current = scaleOf(image, live ? previous.current : null) ?? { nearM: 0, farM: 1 };
    return previous.current;
  }, [image, live]);
}
