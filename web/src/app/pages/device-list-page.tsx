import { DeviceLists, deviceTexts as texts, faultsOf, OperateSelected } from "../../features/devices";
import { type DeviceFilter, type DeviceStore, type Fleet, type KindFilter, matchesFilter, type OwnerFilter } from "../../features/devices/model";
import { FirstSteps } from "../../shared/help";
import { SpaceList } from "../../features/spaces";
import { Choice } from "../../shared/ui/choice";
import { useMemo, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { common } from "../../shared/i18n/common";
import { usePolling } from "../../shared/hooks/use-polling";
import { pairAddress, spaceAddress } from "../../shared/routing/routes";

const NO_FILTER: DeviceFilter = { search: "", kinds: "all", owner: "all", needsAttention: false };
/** Below this number of devices, no filter is shown. */
const SEARCH_FROM = 5;
/** Interval for reading open faults from the cloud; devices publish their own faults immediately [ms]. */
const HEALTH_EVERY_MS = 30_000;

export function DeviceListPage({ api, fleet }: { api: Api; fleet: Fleet }) {
  const devices = fleet.devices.value;
  const [filter, setFilter] = useState(NO_FILTER);
  const lines = usePolling(() => api.health.all(null), HEALTH_EVERY_MS, [api]).value;
  const health = useMemo(() => new Map(lines?.map((line) => [line.device, line])), [lines]);
  const all = [...(devices?.values() ?? [])];
  const shown = all.filter((device) =>
    matchesFilter(device, fleet.spaceName(device.info.value.space), faultsOf(device, health.get(device.id)), filter),
  );
  const shared = all.some((device) => device.info.value.role !== "owner");
  return (
    <main class="page fleet" id="content">
      <div class="fleet-head">
        <h1>{texts.list.title}</h1>
        <a class="elsewhere" href={pairAddress} data-testid="pair">
          {texts.list.pair}
        </a>
      </div>
      {devices === null && <p class="quiet">{common.loading}</p>}
      {devices?.size === 0 && <FirstSteps />}
      {all.length >= SEARCH_FROM && <Search filter={filter} change={setFilter} shared={shared} shown={shown.length} all={all.length} />}
      {all.length > 0 && shown.length === 0 && (
        <p class="row">
          {texts.list.noMatch}
          <button type="button" onClick={() => setFilter(NO_FILTER)}>
            {texts.list.clear}
          </button>
        </p>
      )}
      <OperateSelected devices={all} />
      {bySpace(shown, fleet).map(([space, spaceDevices]) => (
        <section key={space} class="space-group" aria-label={fleet.spaceName(space)} data-testid="space">
          <header class="space-head">
            <h2>{fleet.spaceName(space)}</h2>
            <a href={spaceAddress(space)} aria-label={texts.list.planOf(fleet.spaceName(space))} data-testid="plan-link">
              {texts.list.plan}
            </a>
          </header>
          <DeviceLists devices={spaceDevices} fleet={fleet} health={health} />
        </section>
      ))}
      <SpaceList api={api} fleet={fleet} />
    </main>
  );
}

/** Spaces by name, devices in list order. */
function bySpace(devices: readonly DeviceStore[], fleet: Fleet): [string, DeviceStore[]][] {
  const groups = new Map<string, DeviceStore[]>();
  for (const device of devices) {
    const { space } = device.info.value;
    groups.set(space, [...(groups.get(space) ?? []), device]);
  }
  return [...groups].sort(([one], [other]) => fleet.spaceName(one).localeCompare(fleet.spaceName(other)));
}

interface SearchProps {
  filter: DeviceFilter;
  change: (filter: DeviceFilter) => void;
  /** Whether some devices belong to other accounts. */
  shared: boolean;
  shown: number;
  all: number;
}

function Search({ filter, change, shared, shown, all }: SearchProps) {
  return (
    <form class="row search" role="search" onSubmit={(event) => event.preventDefault()}>
      <label class="visually-hidden" for="search">
        {texts.list.search}
      </label>
      <input
        id="search"
        type="text"
        value={filter.search}
        placeholder={texts.list.searchExample}
        autocomplete="off"
        spellcheck={false}
        data-testid="search"
        onInput={(event) => change({ ...filter, search: event.currentTarget.value })}
      />
      <Choice
        label={texts.list.show}
        value={filter.kinds}
        onChange={(kinds) => change({ ...filter, kinds })}
        options={Object.entries(texts.list.kinds) as [KindFilter, string][]}
      />
      {shared && (
        <Choice
          label={texts.list.owner}
          value={filter.owner}
          onChange={(owner) => change({ ...filter, owner })}
          options={Object.entries(texts.list.owners) as [OwnerFilter, string][]}
        />
      )}
      <label class="check">
        <input
          type="checkbox"
          checked={filter.needsAttention}
          onChange={(event) => change({ ...filter, needsAttention: event.currentTarget.checked })}
        />
        {texts.list.needsAttention}
      </label>
      <span class="quiet small" role="status">
        {texts.list.shown(shown, all)}
      </span>
    </form>
  );
}
