import type { Upload } from "../../shared/api/types";
import { unavailableReason } from "../devices";
import type { DeviceStore } from "../devices/model";
import { Age } from "../../shared/ui/age";
import { Card } from "../../shared/ui/card";
import { useState } from "preact/hooks";
import { toPageClock } from "../../shared/lib/clock";
import type { RoomDeviceAction } from "./model/room-device-action";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";

/** Captures that have their own card. */
const WITH_OWN_CARD = ["image", "depth", "scan"];

interface FilesProps {
  device: DeviceStore;
  roomAction: RoomDeviceAction;
}

/** Captured files, with download links. */
export function CapturesCard({ device, roomAction }: FilesProps) {
  const uploads = roomAction.uploads.value;
  const otherCaptures = (device.description.value?.captures ?? []).filter((name) => !WITH_OWN_CARD.includes(name));
  const unavailable = unavailableReason(device);
  const [capturing, setCapturing] = useState("");
  const capture = async (name: string): Promise<void> => {
    setCapturing(name);
    await roomAction.capture(name);
    setCapturing("");
  };
  return (
    <Card title={texts.files.title}>
      {otherCaptures.length > 0 && (
        <div class="row">
          {otherCaptures.map((name) => (
            <button
              key={name}
              type="button"
              data-testid={`capture-${name}`}
              disabled={unavailable !== "" || roomAction.busy.value !== null}
              title={unavailable}
              onClick={() => void capture(name)}
            >
              {capturing === name ? texts.files.capturing : texts.files.capture(name)}
            </button>
          ))}
        </div>
      )}
      {uploads === null && <p class="quiet">{common.loading}</p>}
      {uploads?.length === 0 && <p class="quiet">{texts.files.none}</p>}
      {uploads !== null && uploads.length > 0 && (
        <ul class="file-list" data-testid="files">
          {uploads.map((upload) => (
            <File key={upload.id} upload={upload} roomAction={roomAction} />
          ))}
        </ul>
      )}
    </Card>
  );
}

function File({ upload, roomAction }: { upload: Upload; roomAction: RoomDeviceAction }) {
  const name = upload.name === "" ? upload.stream : upload.name;
  const download = async (): Promise<void> => {
    // The address is valid for one hour, so request it on demand.
    const found = await roomAction.file(upload.id);
    if (found === null) return;
    const link = document.createElement("a");
    link.href = found.url;
    link.download = name;
    link.rel = "noopener";
    // For a store on another origin, browsers ignore `download`: keep this page open.
    link.target = "_blank";
    link.click();
  };
  return (
    <li>
      <span class="file-name">
        {name}
        <span class="quiet small">
          {format.fileSize(upload.length)} · <Age at={toPageClock(Date.parse(upload.at))} />
        </span>
      </span>
      <button type="button" aria-label={texts.files.downloadNamed(name)} onClick={() => void download()}>
        {texts.files.download}
      </button>
    </li>
  );
}
