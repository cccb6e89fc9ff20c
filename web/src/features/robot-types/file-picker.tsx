/** Selects robot type files: dropped, or chosen as folder, archive or single files. They stay until saved. */
import { Card } from "../../shared/ui/card";
import { useRef, useState } from "preact/hooks";
import type { UploadDraft } from "./model/upload-draft";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { ArchiveError, filesFromDrop, filesFromPicker, readFiles } from "./read-archive";

const WANTED = ".zip,.toml,.xml,.stl,.obj,.png,.py";

export function FilePicker({ draft }: { draft: UploadDraft }) {
  const [over, setOver] = useState(false);
  const [reading, setReading] = useState(false);
  const [wrong, setWrong] = useState("");
  const folder = useRef<HTMLInputElement>(null);
  const files = useRef<HTMLInputElement>(null);
  const words = texts.adding;

  const take = async (chosen: Promise<[string, File][]>): Promise<void> => {
    setWrong("");
    setReading(true);
    try {
      const found = await readFiles(await chosen);
      setReading(false);
      if (found.size > 0) await draft.add(found);
    } catch (error) {
      setWrong(error instanceof ArchiveError ? words.badArchive(error.message) : words.unreadable);
    } finally {
      setReading(false);
    }
  };
  const input = (event: { currentTarget: HTMLInputElement }): void => {
    void take(Promise.resolve(filesFromPicker(event.currentTarget.files)));
    // Allows choosing the same file again after a correction.
    event.currentTarget.value = "";
  };
  return (
    <div
      class={`drop ${over ? "over-it" : ""}`}
      data-testid="drop-files"
      onDragOver={(event) => {
        event.preventDefault();
        setOver(true);
      }}
      onDragLeave={() => setOver(false)}
      onDrop={(event) => {
        event.preventDefault();
        setOver(false);
        if (event.dataTransfer !== null) void take(filesFromDrop(event.dataTransfer));
      }}
    >
      <p>{words.drop}</p>
      <div class="row">
        <button type="button" class="primary" onClick={() => files.current?.click()}>
          {words.chooseFiles}
        </button>
        <button type="button" onClick={() => folder.current?.click()}>
          {words.chooseFolder}
        </button>
      </div>
      <input
        ref={files}
        class="visually-hidden"
        type="file"
        multiple
        accept={WANTED}
        tabIndex={-1}
        aria-label={words.chooseFiles}
        data-testid="type-files"
        onChange={input}
      />
      <input
        ref={(each) => {
          folder.current = each;
          each?.setAttribute("webkitdirectory", "");
        }}
        class="visually-hidden"
        type="file"
        tabIndex={-1}
        aria-label={words.chooseFolder}
        data-testid="type-folder"
        onChange={input}
      />
      <p class="field-error" role="alert">
        {wrong}
      </p>
      {reading && <p role="status">{words.reading}</p>}
    </div>
  );
}

export function SelectedFiles({ draft }: { draft: UploadDraft }) {
  const names = [...draft.files.value.keys()].sort();
  const left = draft.left.value;
  const words = texts.adding;
  if (names.length === 0 && left.length === 0) return null;
  const wrong = new Set(draft.errors.value.map(({ file }) => file));
  return (
    <Card
      title={words.chosen}
      aside={
        names.length > 0 && (
          <button type="button" class="plain" onClick={() => void draft.clear()}>
            {words.clear}
          </button>
        )
      }
    >
      <ul class="type-files" aria-label={words.chosen} data-testid="chosen-files">
        {names.map((name) => (
          <FileRow key={name} draft={draft} name={name} wrong={wrong.has(name)} />
        ))}
      </ul>
      {left.length > 0 && <p class="quiet small">{words.left(left)}</p>}
    </Card>
  );
}

function FileRow({ draft, name, wrong }: { draft: UploadDraft; name: string; wrong: boolean }) {
  const input = useRef<HTMLInputElement>(null);
  const words = texts.adding;
  return (
    <li data-file={name}>
      <span class="file-name">
        {name} <span class="quiet small">{format.fileSize(draft.files.value.get(name)?.length ?? 0)}</span>{" "}
        {wrong && <span class="chip bad">{words.wrong}</span>}
      </span>
      <button type="button" class="plain" aria-label={words.replaceNamed(name)} onClick={() => input.current?.click()}>
        {words.replace}
      </button>
      <button type="button" class="plain" aria-label={words.removeNamed(name)} onClick={() => void draft.remove(name)}>
        {words.remove}
      </button>
      <input
        ref={input}
        class="visually-hidden"
        type="file"
        tabIndex={-1}
        aria-label={words.replaceNamed(name)}
        onChange={(event) => {
          const file = event.currentTarget.files?.[0];
          event.currentTarget.value = "";
          if (file !== undefined) void file.arrayBuffer().then((content) => draft.replace(name, new Uint8Array(content)));
        }}
      />
    </li>
  );
}
