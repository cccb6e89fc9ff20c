/** A link that is shown once. */
import { useEffect, useRef } from "preact/hooks";
import { common } from "../i18n/common";
import { CopyOnce } from "./copy-once";

interface LinkOnceProps {
  link: string;
  /** The recipient and the expiry. */
  note: string;
  onClose: () => void;
}

export function LinkOnce({ link, note, onClose }: LinkOnceProps) {
  const box = useRef<HTMLDivElement>(null);
  useEffect(() => box.current?.querySelector("input")?.focus(), []);
  return (
    <div class="panel made" ref={box} role="group" aria-label={common.createdLink.label}>
      <p>
        <strong>{common.createdLink.created}</strong>
      </p>
      <CopyOnce id="invitation-link" label={common.createdLink.label} value={link} />
      <p class="quiet small">{note}</p>
      <div class="row">
        <button type="button" onClick={onClose}>
          {common.createdLink.close}
        </button>
      </div>
    </div>
  );
}
