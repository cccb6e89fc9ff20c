/** A link that is shown once. */
import { useEffect, useRef } from "preact/hooks";
import { common } from "../i18n/common";
import { CopyOnce } from "./copy-once";

interface MadeLinkProps {
  link: string;
  /** The recipient and the expiry. */
  note: string;
  onDone: () => void;
}

export function LinkOnce({ link, note, onDone }: MadeLinkProps) {
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
        <button type="button" onClick={onDone}>
          {common.createdLink.close}
        </button>
      </div>
    </div>
  );
}
