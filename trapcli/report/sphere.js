// The path of the viewing direction on a sphere that the mouse turns.
"use strict";
(() => {
  const path = JSON.parse(document.getElementById("path").textContent);
  const canvas = document.getElementById("sphere");
  const slider = document.getElementById("moment");
  const context = canvas.getContext("2d");
  const size = 420, radius = 170, middle = size / 2;
  const density = Math.max(2, window.devicePixelRatio || 1);
  canvas.width = canvas.height = size * density;
  const last = path.points.length - 1;
  const stops = [[44, 42, 134], [31, 127, 184], [53, 167, 121], [224, 162, 26], [200, 55, 45]];

  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => { const n = Math.hypot(...a) || 1; return a.map((x) => x / n); };

  function startView() {
    const known = path.points.filter(Boolean);
    const sum = known.reduce((s, p) => [s[0] + p[0], s[1] + p[1], s[2] + p[2]], [0, 0, 0]);
    const front = Math.hypot(...sum) > 0.2 * known.length ? unit(sum) : [0.5, -0.5, Math.SQRT1_2];
    const aside = Math.abs(front[1]) < 0.9 ? [0, 1, 0] : [1, 0, 0];
    const away = front.map((x) => -x);
    const right = unit(cross(aside, away));
    // a little from above, so that a path along a great circle is no straight line
    return times(times(turnX(0.35), turnY(-0.35)), [right, cross(away, right), away]);
  }

  let view = startView();
  const seen = (p) => [dot(view[0], p), dot(view[1], p), dot(view[2], p)];
  const place = (q) => [middle + radius * q[0], middle + radius * q[1]];

  function colour(share) {
    const x = Math.min(share, 0.9999) * (stops.length - 1), i = Math.floor(x), f = x - i;
    return stops[i].map((c, k) => Math.round(c + f * (stops[i + 1][k] - c))).join(",");
  }

  function line(a, b, style, width) {
    context.strokeStyle = style;
    context.lineWidth = width;
    context.beginPath();
    context.moveTo(...place(a));
    context.lineTo(...place(b));
    context.stroke();
  }

  function circle(points, front) {
    const rotated = points.map(seen);
    for (let i = 1; i < rotated.length; i += 1) {
      if (rotated[i][2] < 0 === front) line(rotated[i - 1], rotated[i], front ? "#c4c9d2" : "#e9ebef", 0.7);
    }
  }

  function grid(front) {
    const steps = [...Array(73).keys()].map((i) => (i * Math.PI) / 36);
    for (let k = -2; k <= 2; k += 1) {
      const h = Math.sin((k * Math.PI) / 6), r = Math.cos((k * Math.PI) / 6);
      circle(steps.map((s) => [r * Math.cos(s), h, r * Math.sin(s)]), front);
    }
    for (let k = 0; k < 6; k += 1) {
      const c = Math.cos((k * Math.PI) / 6), s = Math.sin((k * Math.PI) / 6);
      circle(steps.map((a) => [c * Math.cos(a), Math.sin(a), s * Math.cos(a)]), front);
    }
  }

  function axes(front) {
    context.font = "13px system-ui, sans-serif";
    context.textAlign = "center";
    context.textBaseline = "middle";
    for (let k = 0; k < 3; k += 1) {
      const end = seen([0, 1, 2].map((j) => (j === k ? 1 : 0)));
      if (end[2] < 0 !== front) continue;
      line(end, end.map((x) => 1.09 * x), front ? "#555" : "#b5b5b5", 1.5);
      context.fillStyle = front ? "#333" : "#a0a0a0";
      context.fillText(String(k + 1), ...place(end.map((x) => 1.17 * x)));
    }
  }

  function route(front) {
    for (let i = 1; i <= last; i += 1) {
      if (!path.points[i - 1] || !path.points[i]) continue;
      const a = seen(path.points[i - 1]), b = seen(path.points[i]);
      if (b[2] < 0 !== front) continue;
      const good = path.valid[i - 1] && path.valid[i];
      const rgb = good ? colour(i / last) : "150,150,150";
      line(a, b, `rgba(${rgb},${front ? 1 : 0.3})`, good ? 3 : 1.5);
    }
  }

  function mark(index, front, filled) {
    if (!path.points[index]) return;
    const q = seen(path.points[index]);
    if (q[2] < 0 !== front) return;
    context.beginPath();
    context.arc(...place(q), filled ? 7 : 5, 0, 2 * Math.PI);
    context.fillStyle = filled ? `rgba(${colour(index / (last || 1))},${front ? 1 : 0.4})` : "#fff";
    context.fill();
    context.lineWidth = 1.5;
    context.strokeStyle = front ? "#222" : "#aaa";
    context.stroke();
  }

  function draw() {
    context.setTransform(density, 0, 0, density, 0, 0);
    context.clearRect(0, 0, size, size);
    context.lineCap = "round";
    const light = context.createRadialGradient(middle - 60, middle - 60, 20, middle, middle, radius);
    light.addColorStop(0, "#ffffff");
    light.addColorStop(1, "#eef0f4");
    context.fillStyle = light;
    context.beginPath();
    context.arc(middle, middle, radius, 0, 2 * Math.PI);
    context.fill();
    for (const front of [false, true]) {
      grid(front);
      axes(front);
      route(front);
      mark(0, front, false);
      mark(Number(slider.value), front, true);
    }
  }

  function tell() {
    const i = Number(slider.value), p = path.points[i];
    const time = path.unit === "frame" ? "" : `t = ${path.time[i]} ${path.unit}, `;
    const where = p ? `γ = (${p.map((x) => x.toFixed(2)).join(", ")})` : "γ is not known";
    document.getElementById("where").textContent = `${time}frame ${path.frame[i]}: ${where}`;
  }

  function turn(dx, dy) {
    view = times(times(turnX(dy / radius), turnY(-dx / radius)), view);
    draw();
  }

  turnable(canvas, size, turn);
  slider.max = String(last);
  slider.addEventListener("input", () => { tell(); draw(); });

  const label = (i) => `${path.unit === "frame" ? path.frame[i] : path.time[i]} ${path.unit}`;
  document.getElementById("start").textContent = label(0);
  document.getElementById("end").textContent = label(last);
  tell();
  draw();
})();
