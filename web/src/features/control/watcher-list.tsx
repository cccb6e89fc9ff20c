/** Number and names of the other viewers, while the server's list is current. */
import { Age } from "../../shared/ui/age";
import { shortId } from "../../shared/lib/account-label";
import { toPageClock } from "../../shared/lib/clock";
import type { Watchers } from "./model/watchers";
import { common } from "../../shared/i18n/common";
import { texts } from "./texts";

interface WatchersButtonProps {
  watchers: Watchers;
  open: boolean;
  /** The id of their names. */
  names: string;
  onToggle: () => void;
}

export function WatchersButton({ watchers, open, names, onToggle }: WatchersButtonProps) {
  const others = watchers.others.value ?? [];
  if (others.length === 0) return null;
  return (
    <button
      type="button"
      class="plain watchers"
      data-testid="watchers"
      data-count={others.length}
      aria-expanded={open}
      aria-controls={names}
      onClick={onToggle}
    >
      {texts.watchers.count(others.length)}
    </button>
  );
}

export function WatcherNames({ watchers, id }: { watchers: Watchers; id: string }) {
  const others = watchers.others.value ?? [];
  if (others.length === 0) return null;
  return (
    <ul class="bar-row watcher-names" id={id} aria-label={texts.watchers.title} data-testid="watcher-names">
      {others.map(({ name, account, role, mine, since }, index) => (
        <li key={index}>
          {name} <span class="quiet small">
            {shortId(account)}, {mine ? texts.watchers.mine : common.role[role].toLowerCase()}, <Age at={toPageClock(Date.parse(since))} as={texts.watchers.since} />
          </span>
        </li>
      ))}
    </ul>
  );
}
