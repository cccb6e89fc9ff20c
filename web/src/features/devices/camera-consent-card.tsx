/** Which cameras of a device may be recorded: shown to everyone, decided by the owner. */
import { useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { sentence } from "../../shared/api/http";
import { Card } from "../../shared/ui/card";
import { ConfirmButton } from "../../shared/ui/confirm-button";
import { recordableCameras } from "./model/recorded-cameras";
import type { DeviceStore } from "./model/device-store";
import { texts } from "./texts";

/** Nothing for a device whose cameras cannot be recorded. */
export function CameraConsentCard({ api, device }: { api: Api; device: DeviceStore }) {
  const [note, setNote] = useState("");
  const state = device.state.value;
  const consent = state?.camera_consent ?? null;
  const cameras = recordableCameras(device);
  if (state === null || consent === null || cameras.length === 0) return null;
  const owner = device.info.value.role === "owner";
  const allowed = consent.cameras ?? [];
  const by = consent.by ?? "";

  const decide = async (next: readonly string[]): Promise<void> => {
    setNote("");
    const { confirmed, reason } = await api.recordings.setCameraConsent(device.id, next);
    if (!confirmed) setNote(reason === null ? texts.consent.unconfirmed : texts.consent.rejected(reason.message));
  };
  const withdraw = (camera: string): void => {
    decide(allowed.filter((each) => each !== camera)).catch((error: unknown) => setNote(sentence(error)));
  };
  return (
    <Card title={texts.cards.consent} data-testid="camera-consent">
      <p class="small">{texts.consent.explained}</p>
      <ul>
        {cameras.map((camera) => {
          const isAllowed = allowed.includes(camera);
          const recorded = device.live.value && state.recorded_cameras.includes(camera);
          return (
            <li key={camera} data-camera={camera} data-allowed={isAllowed} class="row">
              <span>
                {camera}: {recorded ? texts.consent.recordedNow : isAllowed ? texts.consent.allowed : texts.consent.forbidden}
              </span>
              {owner && isAllowed && (
                <button type="button" data-testid="withdraw-consent" onClick={() => withdraw(camera)}>
                  {texts.consent.withdraw}
                </button>
              )}
              {owner && !isAllowed && (
                <ConfirmButton
                  label={texts.consent.allow}
                  description={texts.consent.allowOf(camera)}
                  question={texts.consent.question}
                  confirmLabel={texts.consent.allow}
                  busyLabel={texts.consent.saving}
                  cancelLabel={texts.naming.cancel}
                  data-testid="give-consent"
                  onConfirm={() => decide([...allowed, camera])}
                />
              )}
            </li>
          );
        })}
      </ul>
      <p class="quiet small">
        {by === "" ? texts.consent.never : texts.consent.decided(by)} {!owner && texts.consent.ownerOnly}
      </p>
      {note !== "" && (
        <p class="notice warn" role="alert">
          {note}
        </p>
      )}
    </Card>
  );
}
