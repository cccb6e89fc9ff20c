/** Renames a device in place, with undo. For its owner. */
import { useEffect, useRef, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import type { DeviceStore } from "./model/device-store";
import { sentence } from "../../shared/api/http";
import { texts } from "./texts";
import { useReturnFocus } from "../../shared/hooks/use-return-focus";

export function RenameDevice({ api, device }: { api: Api; device: DeviceStore }) {
  const { label, role } = device.info.value;
  const [typed, setTyped] = useState<string | null>(null);
  const [busy, setBusy] = useState(false);
  const [error, setError] = useState("");
  /** The name before the last change. */
  const [previousName, setPreviousName] = useState<string | null>(null);
  const opener = useReturnFocus(typed !== null);
  const field = useRef<HTMLInputElement>(null);
  useEffect(() => field.current?.select(), [typed === null]);
  if (role !== "owner") return null;

  const call = async (name: string, previous: string | null): Promise<void> => {
    setBusy(true);
    setError("");
    try {
      device.update(await api.rename(device.id, name));
      setPreviousName(previous);
      setTyped(null);
    } catch (error) {
      setError(sentence(error)); // The input stays.
    } finally {
      setBusy(false);
    }
  };

  const id = `name-${device.id}`;
  return (
    <div class="naming">
      {typed === null ? (
        <button
          type="button"
          class="plain"
          ref={opener}
          data-testid="rename"
          aria-label={texts.naming.renameOf(label)}
          onClick={() => setTyped(label)}
        >
          {texts.naming.rename}
        </button>
      ) : (
        <form
          class="row"
          onSubmit={(event) => {
            event.preventDefault();
            void call(typed, label);
          }}
        >
          <label for={id}>{texts.naming.name}</label>
          <input
            id={id}
            ref={field}
            type="text"
            required
            pattern=".*\S.*"
            maxLength={80}
            autocomplete="off"
            value={typed}
            data-testid="name"
            onInput={(event) => setTyped(event.currentTarget.value)}
          />
          <button type="submit" data-testid="save-name" disabled={busy}>
            {busy ? texts.naming.saving : texts.naming.save}
          </button>
          <button type="button" class="plain" disabled={busy} onClick={() => setTyped(null)}>
            {texts.naming.cancel}
          </button>
        </form>
      )}
      <span role="status" class="small">
        {previousName !== null && typed === null && (
          <>
            {texts.naming.renamed(label)}{" "}
            <button type="button" class="plain" data-testid="undo-name" disabled={busy} onClick={() => void call(previousName, null)}>
              {texts.naming.undo}
            </button>
          </>
        )}
        {error !== "" && <span class="field-error">{error}</span>}
      </span>
    </div>
  );
}
