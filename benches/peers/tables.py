"""Tables of the results of a run: medians, ratios, Markdown."""

from statistics import median

# Relative difference in triangles above which times are also compared per triangle.
NEAR = 0.05
SURFACES = {
    "same": "ours",
    "gaussian": "Gaussian, near ours",
    "other": "another Gaussian",
    "ses": "solvent-excluded",
}
HEAD = ["program", "surface", "s", "× time", "MB", "× memory", "triangles", "a triangle: × time", "× memory",
        "closed", "area Å²", "volume Å³"]  # fmt: skip


def summary(runs):
    """Adds medians of rounds (each with `wall` in s and `kb`), and medians of ratios between runs of the same round."""
    ours = {run["round"]: run for run in runs["molmesh"]["runs"]} if "runs" in runs.get("molmesh", {}) else {}
    for entry in runs.values():
        if not entry.get("runs"):
            continue
        entry["seconds"] = median(run["wall"] for run in entry["runs"])
        entry["megabytes"] = median(run["kb"] for run in entry["runs"]) / 1024
        pairs = [(run, ours[run["round"]]) for run in entry["runs"] if run["round"] in ours]
        if pairs:
            entry["times_ours"] = median(theirs["wall"] / own["wall"] for theirs, own in pairs)
            entry["memory_ours"] = median(theirs["kb"] / own["kb"] for theirs, own in pairs)
        near_equal(entry, runs["molmesh"].get("mesh"))
    late(runs)
    return runs


def near_equal(entry, ours):
    """Adds ratios per triangle if the numbers of triangles differ by more than `NEAR`."""
    theirs = entry.get("mesh")
    if not (ours and theirs and theirs.get("triangles") and "times_ours" in entry):
        return
    factor = ours["triangles"] / theirs["triangles"]
    if abs(1 / factor - 1) > NEAR:
        entry["times_ours_per_triangle"] = entry["times_ours"] * factor
        entry["memory_ours_per_triangle"] = entry["memory_ours"] * factor


def late(runs):
    """Adds the minimum ratio of programs that exceeded the time limit."""
    ours = runs.get("molmesh", {}).get("seconds")
    for entry in runs.values():
        if "limit" in entry and ours:
            entry["times_ours_at_least"] = entry["limit"] / ours


def significant(value, digits=3):
    """Formats a number with a few significant digits, without an exponent."""
    if value == 0:
        return "0"
    text = f"{value:.{digits}g}"
    return f"{float(text):,.0f}" if "e" in text or abs(value) >= 1000 else text


def mesh_cells(mesh):
    if not mesh:
        return ["–"] * 4
    if "closed" not in mesh:  # an area without a mesh
        return ["–", "–", significant(mesh["area"], 4), "–"]
    if mesh["closed"]:
        closed = "yes"
    else:
        closed = f"no: {mesh['open_edges']:,} open edges, {mesh['crowded_edges']:,} with more than two triangles"
    if mesh["merged"]:
        closed += " (merged)"
    return [f"{mesh['triangles']:,}", closed, significant(mesh["area"], 4), significant(mesh["volume"], 4)]


def row(name, entry):
    """Returns the cells of one program, in the order of `HEAD`."""
    surface = SURFACES.get(entry["surface"], entry["surface"])
    triangles, closed, area, volume = mesh_cells(entry.get("mesh"))
    if "missing" in entry or "failed" in entry:
        why = f"not available: {entry['missing']}" if "missing" in entry else f"failed: {entry['failed']}"
        return [name, surface, why.replace("|", "/"), *["–"] * (len(HEAD) - 3)]
    if "limit" in entry:
        ratio = f"> {significant(entry['times_ours_at_least'])}" if "times_ours_at_least" in entry else "–"
        return [name, surface, f"more than {entry['limit']:g}", ratio, *["–"] * (len(HEAD) - 4)]

    def optional(key):
        return significant(entry[key]) if key in entry else "–"

    return [
        name, surface, significant(entry["seconds"]), optional("times_ours"), f"{entry['megabytes']:,.0f}",
        optional("memory_ours"), triangles, optional("times_ours_per_triangle"), optional("memory_ours_per_triangle"),
        closed, area, volume,
    ]  # fmt: skip


def markdown(rows, head=HEAD):
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join(lines + ["| " + " | ".join(cells) + " |" for cells in rows])


def terminal(rows):
    """Formats a table for the terminal, with text left-aligned and figures right-aligned."""
    rows = [HEAD, *rows]
    widths = [max(len(cells[k]) for cells in rows if len(cells[2]) < 24 or k < 2) for k in range(len(HEAD))]
    left = {0, 1, HEAD.index("closed")}

    def line(cells):
        if len(cells[2]) >= 24:  # a reason, not a figure
            return f"{cells[0]:<{widths[0]}}  {cells[1]:<{widths[1]}}  {cells[2]}"
        return "  ".join(f"{c:<{w}}" if k in left else f"{c:>{w}}" for k, (c, w) in enumerate(zip(cells, widths)))

    return "\n".join(line(cells).rstrip() for cells in rows)


def section(structure):
    """Returns the title and the rows of one structure."""
    title = f"{structure['name'].upper()}: {structure['atoms']:,} atoms"
    title += f", cores: {structure['cores']}" if "cores" in structure else ""
    return title, [row(name, entry) for name, entry in structure["programs"].items()]


def package_tables(result):
    """Formats a table for each structure, with one row per task and package. Memory and mesh are those of the run on
    the most cores."""
    cores = result["machine"]["cores"]
    head = ["task", "package", "1 core: s", HEAD[3], f"{cores} cores: s", *(HEAD[k] for k in (3, 4, 6, 9, 10))]
    for name in dict.fromkeys(s["name"] for s in result["structures"]):
        groups = [s for s in result["structures"] if s["name"] == name]
        cells = {}
        for group in groups:
            for program, entry in group["programs"].items():
                cells.setdefault((entry["surface"], program), {})[group["cores"]] = row(program, entry)
        rows = []
        for (task, program), runs in cells.items():
            times = [runs.get(n, ["–"] * len(HEAD))[2:4] for n in (1, cores)]
            if times[0] == times[1] and times[0][0][0].isalpha():  # a reason
                times[1] = ["–", "–"]
            version = result["versions"].get(program, program).split(",")[0]
            rows.append([task, version, *times[0], *times[1], *(runs[max(runs)][k] for k in (4, 6, 9, 10))])
        yield f"### {name.upper()}: {groups[0]['atoms']:,} atoms"
        yield markdown(rows, head)


def overview(result):
    """Formats the relative times of all programs and structures, with one row per program."""
    structures = result["structures"]
    lines = ["| × our time | " + " | ".join(s["name"].upper() for s in structures) + " |",
             "|" + "---|" * (len(structures) + 1)]  # fmt: skip
    names = list(dict.fromkeys(name for s in structures for name in s["programs"] if name != "molmesh"))
    for name in names:
        cells = []
        for structure in structures:
            entry = structure["programs"].get(name, {})
            if "times_ours" in entry:
                cells.append(significant(entry["times_ours"]))
            elif "times_ours_at_least" in entry:
                cells.append(f"> {significant(entry['times_ours_at_least'])}")
            else:
                cells.append("–")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def page(result):
    """Formats all results as Markdown, machine and versions first."""
    machine = result["machine"]
    versions = [version for version in dict.fromkeys(result["versions"].values()) if version]
    loads = [machine["load"], *(s["load"] for s in result["structures"] if "load" in s)]
    note = f" {result['note']}" if result.get("note") else ""
    load = f"load {loads[0]:.1f} at the start" if len(loads) == 1 else f"load between {min(loads):.1f} and {max(loads):.1f}"
    parts = [
        f"{machine['cpu']}, {machine['cores']} cores, {machine['memory_gb']:.0f} GB, {machine['system']}; {load}.",
        f"{result['date']}, grid {result['spacing']:g} Å, {result['rounds']} rounds after"
        f" one that is not timed, {result['limit']:g} s a run at most.{note}",
    ]
    if "cores" in result["structures"][0]:
        return "\n\n".join([*parts, *package_tables(result)])
    parts += ["\n".join(f"- {version}" for version in versions), overview(result)]
    for structure in result["structures"]:
        title, rows = section(structure)
        parts += [f"### {title}", markdown(rows)]
    return "\n\n".join(parts)


def between(text, content, name):
    """Returns `text` with the content between the two markers of this name replaced. Raises ValueError unless each
    marker occurs once."""
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        raise ValueError(f"the page must have {begin} and {end}, once each and in this order")
    head, rest = text.split(begin)
    return f"{head}{begin}\n\n{content}\n\n{end}{rest.split(end)[1]}"
