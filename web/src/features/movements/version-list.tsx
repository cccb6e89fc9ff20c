/** All versions of a movement: compare one with the editor, and restore it. */
import { Card } from "../../shared/ui/card";
import { useEffect, useRef, useState } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { sentence } from "../../shared/api/http";
import type { Movement } from "../../shared/api/movement-library";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { Comparison } from "./code-editor";

/** Two texts with their differences. */
export function ScriptDiff({ before, after, label }: { before: string; after: string; label: string }) {
  const host = useRef<HTMLDivElement>(null);
  useEffect(() => {
    if (host.current === null) return undefined;
    const comparison = new Comparison(host.current, before, after, label);
    return () => comparison.dispose();
  }, [before, after, label]);
  return <div class="code difference" data-testid="difference" ref={host} />;
}

interface VersionsProps {
  api: Api;
  robotType: string;
  name: string;
  /** The newest known version; the list is reloaded when it changes. */
  newest: number;
  text: string;
  onRestore: (source: string) => Promise<void>;
}

export function VersionList({ api, robotType, name, newest, text, onRestore }: VersionsProps) {
  const [versions, setVersions] = useState<readonly Movement[]>([]);
  const [looked, setLooked] = useState<{ version: number; source: string } | null>(null);
  const [why, setWhy] = useState("");
  const [working, setWorking] = useState(false);
  useEffect(() => {
    let wanted = true;
    setLooked(null);
    if (newest === 0) return undefined;
    api.library.versions(robotType, name).then(
      (found) => wanted && setVersions(found),
      (error: unknown) => wanted && setWhy(sentence(error)),
    );
    return () => {
      wanted = false;
    };
  }, [api, robotType, name, newest]);

  const attempt = async (work: () => Promise<void>): Promise<void> => {
    setWorking(true);
    setWhy("");
    try {
      await work();
    } catch (error) {
      setWhy(sentence(error));
    } finally {
      setWorking(false);
    }
  };
  const look = (version: number): Promise<void> =>
    attempt(async () => {
      setLooked({ version, source: (await api.library.get(robotType, name, version)).source });
    });

  if (newest === 0) return null;
  return (
    <Card title={texts.versions.title} class="versions">
      <ul class="version-list">
        {versions.map((version) => (
          <li key={`${version.version}-${String(version.built_in)}`} data-testid={`version-${version.version}`}>
            <span>
              <strong>{texts.versions.one(version.version)}</strong>{" "}
              <span class="quiet small">
                {version.built_in ? texts.library.builtIn : format.dateTime(version.updated_at)}
              </span>
            </span>
            <button
              type="button"
              class="plain"
              aria-expanded={looked?.version === version.version}
              aria-label={looked?.version === version.version ? texts.versions.closeOf(version.version) : texts.versions.lookAt(version.version)}
              disabled={working}
              onClick={() => (looked?.version === version.version ? setLooked(null) : void look(version.version))}
            >
              {looked?.version === version.version ? texts.versions.close : texts.versions.look}
            </button>
          </li>
        ))}
      </ul>
      <p class="field-error" role="alert">
        {why}
      </p>
      {looked !== null && (
        <section class="looked" aria-label={texts.versions.one(looked.version)}>
          <p class="quiet small">
            {looked.source === text ? texts.versions.same(looked.version) : texts.versions.explain(looked.version)}
          </p>
          <ScriptDiff before={looked.source} after={text} label={texts.versions.label(looked.version)} />
          {looked.source !== text && (
            <button
              type="button"
              data-testid="restore-version"
              disabled={working}
              onClick={() => void attempt(() => onRestore(looked.source))}
            >
              {working ? texts.editor.saving : texts.versions.restore(looked.version)}
            </button>
          )}
        </section>
      )}
    </Card>
  );
}
