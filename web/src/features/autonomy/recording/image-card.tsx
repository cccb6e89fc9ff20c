/** The recorded image of one camera at the shown time. */
import { useSignalEffect } from "@preact/signals";
import { useRef, useState } from "preact/hooks";
import { format } from "../../../shared/i18n/format";
import { Card } from "../../../shared/ui/card";
import type { Images, Replay } from "../model/recording";
import { texts } from "./texts";

export function ImageCard({ replay, topic }: { replay: Replay; topic: string }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const drawn = useRef<Wanted | null>(null);
  const [failed, setFailed] = useState(false);
  const found = replay.imageAt(topic);
  useSignalEffect(() => {
    const next = replay.imageAt(topic);
    const last = drawn.current;
    if (next === null || (last?.images === next.images && last.index === next.index)) return;
    drawn.current = next;
    void decoded(next).then(
      (image) => {
        // A newer image may have been decoded first.
        if (drawn.current === next && canvas.current !== null) paint(canvas.current, image);
        image.close();
        setFailed(false);
      },
      () => setFailed(true),
    );
  });
  const moment = replay.shown.value;
  return (
    <Card title={texts.images.title(topic)} class="picture">
      <div class="canvas-box image-box" data-testid="session-image" data-topic={topic}>
        <canvas ref={canvas} role="img" aria-label={texts.images.label(topic)} class={found === null ? "session-hidden" : ""} width={320} height={240} />
        {found === null && <p class="over quiet">{moment.kind === "sample" ? texts.images.loading : texts.images.none}</p>}
        {found !== null && failed && <p class="over notice bad">{texts.images.undecodable}</p>}
      </div>
      <p class="quiet small">{found === null ? format.unknown : texts.images.age(format.milliseconds(found.age_s * 1000))}</p>
    </Card>
  );
}

interface Wanted {
  images: Images;
  index: number;
}

function decoded({ images, index }: Wanted): Promise<ImageBitmap> {
  const content = images.data.subarray(images.offsets[index], images.offsets[index + 1]);
  return createImageBitmap(new Blob([content], { type: images.types[index] ?? "" }));
}

function paint(canvas: HTMLCanvasElement, image: ImageBitmap): void {
  if (canvas.width !== image.width) canvas.width = image.width;
  if (canvas.height !== image.height) canvas.height = image.height;
  canvas.getContext("2d")?.drawImage(image, 0, 0);
}
