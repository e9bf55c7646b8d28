// The calibration page moves: the array turns, tables sort. Nothing is fetched; lengths are mm.
"use strict";
(() => {
  const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

  function projector(view, [width, height]) {
    const cy = Math.cos(view.yaw), sy = Math.sin(view.yaw);
    const cp = Math.cos(view.pitch), sp = Math.sin(view.pitch);
    return (point) => {  // to the right, down, and nearness
      const [x, y, z] = point.map((value, axis) => value - view.target[axis]);
      const near = sy * cp * x + sp * y + cy * cp * z;
      const scale = view.zoom / Math.max(view.away - near, 0.05 * view.away);
      return [width / 2 + scale * (cy * x - sy * z),
        height / 2 - scale * (cp * y - sy * sp * x - cy * sp * z), near];
    };
  }

  function arrayView(root) {
    const scene = JSON.parse(root.querySelector("[data-scene]").textContent);
    const svg = root.querySelector("svg"), view = { ...scene.view }, fingers = new Map();
    const pieces = [...svg.querySelectorAll("[data-item]")].map((group) => ({
      group, paths: group.querySelectorAll("path"), words: group.querySelector("text"),
      told: group.querySelector("title"), ...scene.items[Number(group.dataset.item)],
    }));
    let waiting = false;
    const draw = () => {
      waiting = false;
      const project = projector(view, scene.size);
      for (const piece of pieces) {
        const placed = piece.lines.map((line) => line.map(project)), all = placed.flat();
        piece.near = all.reduce((sum, point) => sum + point[2], 0) / all.length;
        placed.forEach((line, at) => piece.paths[at].setAttribute("d", "M" + line.map(
          ([x, y]) => `${x.toFixed(1)} ${y.toFixed(1)}`).join("L") + (piece.closed ? "Z" : "")));
        if (!piece.words) continue;
        const [x, y] = project(piece.at);
        piece.words.setAttribute("x", x.toFixed(1));
        piece.words.setAttribute("y", (y + 4).toFixed(1));
      }
      pieces.sort((a, b) => a.near - b.near).forEach((piece) => svg.append(piece.group));
    };
    const redraw = () => { if (!waiting) { waiting = true; requestAnimationFrame(draw); } };
    const turn = (yaw, pitch) => {
      view.yaw += yaw;
      view.pitch = clamp(view.pitch + pitch, -1.55, 1.55);
      redraw();
    };
    const zoom = (by) => {
      view.zoom = clamp(view.zoom * by, 0.3 * scene.view.zoom, 8 * scene.view.zoom);
      redraw();
    };
    const home = () => { Object.assign(view, scene.view); redraw(); };
    const paint = (index) => {
      for (const piece of pieces) {
        if (piece.device < 0 || !scene.colours.length) continue;
        piece.group.style.setProperty("--own", scene.colours[index][piece.device]);
        piece.told.textContent = `${piece.words.textContent}, ${scene.told[index][piece.device]}`;
      }
      for (const legend of root.querySelectorAll("[data-legend]"))
        legend.hidden = Number(legend.dataset.legend) !== index;
    };
    svg.addEventListener("pointerdown", (event) => {
      svg.focus({ preventScroll: true });
      svg.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, event);
    });
    svg.addEventListener("pointermove", (event) => {
      const last = fingers.get(event.pointerId);
      if (!last) return;
      turn(-0.008 * (event.clientX - last.clientX), 0.008 * (event.clientY - last.clientY));
      fingers.set(event.pointerId, event);
    });
    for (const name of ["pointerup", "pointercancel"])
      svg.addEventListener(name, (event) => fingers.delete(event.pointerId));
    svg.addEventListener("wheel", (event) => {
      if (document.activeElement !== svg) return;  // the page scrolls on until one clicks here
      event.preventDefault();
      zoom(Math.exp(-0.0012 * event.deltaY));
    }, { passive: false });
    svg.addEventListener("dblclick", home);
    const keys = { ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0), "+": () => zoom(1.1),
      ArrowUp: () => turn(0, 0.1), ArrowDown: () => turn(0, -0.1), "-": () => zoom(0.9), Home: home };
    svg.addEventListener("keydown", (event) => {
      if (!keys[event.key]) return;
      event.preventDefault();
      keys[event.key]();
    });
    for (const button of root.querySelectorAll("[data-yaw]"))
      button.addEventListener("click", () => {
        Object.assign(view, scene.view, { yaw: Number(button.dataset.yaw), pitch: Number(button.dataset.pitch) });
        redraw();
      });
    for (const button of root.querySelectorAll("[data-zoom]"))
      button.addEventListener("click", () => zoom(Number(button.dataset.zoom)));
    const choice = root.querySelector("[data-measure]");
    if (choice) choice.addEventListener("change", () => paint(Number(choice.value)));
    root.querySelector(".look").hidden = false;
    root.view = { view, turn, zoom, draw };  // for whoever looks inside
    paint(0);
    draw();
    root.dataset.state = "ready";
  }

  function sorted(table) {
    const heads = [...table.tHead.rows[0].cells], body = table.tBodies[0];
    const known = (row, column) => row.cells[column].dataset.value ?? row.cells[column].textContent;
    heads.forEach((head, column) => {
      const button = head.querySelector("button");
      button.disabled = false;
      button.addEventListener("click", () => {
        const up = head.getAttribute("aria-sort") !== "ascending", sign = up ? 1 : -1;
        heads.forEach((other) => other.removeAttribute("aria-sort"));
        head.setAttribute("aria-sort", up ? "ascending" : "descending");
        [...body.rows].sort((one, other) => {
          const a = known(one, column), b = known(other, column);
          if (a === "" || b === "") return (a === "") - (b === "");  // what is not known stands last
          const both = Number(a) - Number(b);
          return sign * (Number.isNaN(both) ? a.localeCompare(b, "en", { numeric: true }) : both);
        }).forEach((row) => body.append(row));
      });
    });
  }

  document.querySelectorAll(".arrayview").forEach(arrayView);
  document.querySelectorAll("table.sortable").forEach(sorted);
})();
