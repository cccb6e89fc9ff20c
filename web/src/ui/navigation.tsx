/** The bar above every page: the parts of the console, the account, the way out. */
import type { Account } from "../core/api";
import type { Session } from "../core/session";
import { texts } from "../texts";
import { accountAddress, fleetAddress, healthAddress, movementsAddress, robotTypesAddress, route, type Route, timesAddress } from "./route";

interface Part {
  name: string;
  address: string;
  /** The pages that belong to it. */
  pages: readonly Route["page"][];
}

const PARTS: readonly Part[] = [
  { name: texts.parts.fleet, address: fleetAddress, pages: ["fleet", "device", "keyframes", "space", "together", "pair"] },
  { name: texts.parts.movements, address: movementsAddress, pages: ["movements", "movement"] },
  { name: texts.parts.robotTypes, address: robotTypesAddress, pages: ["robot-types", "robot-type", "add-robot-type"] },
  { name: texts.parts.health, address: healthAddress, pages: ["health"] },
  { name: texts.parts.times, address: timesAddress, pages: ["times"] },
];

export function Navigation({ account, session }: { account: Account; session: Session }) {
  const { page } = route.value;
  return (
    <header class="top">
      <a class="brand" href={fleetAddress}>
        {texts.product}
      </a>
      <nav aria-label={texts.parts.title}>
        {PARTS.map(({ name, address, pages }) => (
          <a key={address} href={address} aria-current={pages.includes(page) ? "page" : undefined}>
            {name}
          </a>
        ))}
      </nav>
      <a class="account" data-testid="signed-in" href={accountAddress} title={texts.session.signedInAs(account.name)}>
        {account.name}
      </a>
      <button type="button" class="plain" onClick={() => void session.signOut()}>
        {texts.session.out}
      </button>
    </header>
  );
}
