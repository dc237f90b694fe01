// The volume, turning by the motion beside the frames: its projection, and a surface that the mouse turns.
"use strict";
(async () => {
  const scene = JSON.parse(document.getElementById("scene").textContent);
  const packed = Uint8Array.from(atob(document.getElementById("samples").textContent.trim()), (c) => c.charCodeAt(0));
  const inflated = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(inflated).arrayBuffer());

  const n = scene.samples, half = n >> 1, plane = n * n, side = scene.side;
  const values = Float32Array.from(bytes.subarray(0, n * plane), (b) => scene.low + ((scene.high - scene.low) * b) / 255);
  const film = bytes.subarray(n * plane);
  const coarse = 128, fine = 216, edge = 432, grip = 0.4 * edge, radius = n / 2 - 1;
  const shape = document.getElementById("shape");
  const slider = document.getElementById("pose"), level = document.getElementById("level");
  const button = document.getElementById("play");
  const solid = document.createElement("canvas");
  const unmoved = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  let view = unmoved;

  // the volume at a point in samples from its centre, between samples; 0 beyond
  function at(x, y, z) {
    const i = Math.floor(x), j = Math.floor(y), k = Math.floor(z);
    const a = i + half, b = j + half, c = k + half;
    if (a < 0 || b < 0 || c < 0 || a >= n - 1 || b >= n - 1 || c >= n - 1) return 0;
    const u = x - i, v = y - j, w = z - k, o = c * plane + b * n + a;
    const low = (values[o] * (1 - u) + values[o + 1] * u) * (1 - v) + (values[o + n] * (1 - u) + values[o + n + 1] * u) * v;
    const p = o + plane;
    const high = (values[p] * (1 - u) + values[p + 1] * u) * (1 - v) + (values[p + n] * (1 - u) + values[p + n + 1] * u) * v;
    return low * (1 - w) + high * w;
  }

  // calls each(pixel, start, reach) for all rays that meet the ball; points of a ray are start + s A e3, |s| <= reach
  function rays(A, pixels, each) {
    const scale = n / pixels;
    for (let row = 0; row < pixels; row += 1) {
      const y = (row - pixels / 2) * scale;
      for (let column = 0; column < pixels; column += 1) {
        const x = (column - pixels / 2) * scale, rest = radius * radius - x * x - y * y;
        if (rest <= 0) continue;
        each(row * pixels + column, A.map((r) => r[0] * x + r[1] * y), Math.sqrt(rest));
      }
    }
  }

  function image(canvas, pixels) {
    canvas.width = canvas.height = pixels;
    const context = canvas.getContext("2d");
    return [context, context.createImageData(pixels, pixels)];
  }

  function project(R) {
    const canvas = document.getElementById("projection"), [context, shown] = image(canvas, coarse);
    const [dx, dy, dz] = R.map((r) => r[2]), grey = new Float32Array(coarse * coarse);
    rays(R, coarse, (pixel, [x, y, z], reach) => {
      let sum = 0;
      // half a sample a step: whole ones would show as stripes
      for (let s = -Math.floor(reach); s <= reach; s += 0.5) sum += at(x + s * dx, y + s * dy, z + s * dz);
      grey[pixel] = 0.5 * sum * scene.step;
    });
    const spread = scene.filmHigh - scene.filmLow || 1;
    grey.forEach((value, i) => {
      shown.data.fill((255 * (value - scene.filmLow)) / spread, 4 * i, 4 * i + 3);
      shown.data[4 * i + 3] = 255;
    });
    context.putImageData(shown, 0, 0);
  }

  // the outward normal on the screen where a ray meets a level, and how deep that is; null where it doesn't
  function meet(A, [x, y, z], reach, limit) {
    const [dx, dy, dz] = A.map((r) => r[2]), step = 0.7;
    let before = 0, now = 0, s = -reach;
    for (; s <= reach; s += step) {
      now = at(x + s * dx, y + s * dy, z + s * dz);
      if (now >= limit) break;
      before = now;
    }
    if (now < limit) return null;
    s -= (step * (now - limit)) / (now - before);
    const p = x + s * dx, q = y + s * dy, r = z + s * dz;
    const g = [at(p + 1, q, r) - at(p - 1, q, r), at(p, q + 1, r) - at(p, q - 1, r), at(p, q, r + 1) - at(p, q, r - 1)];
    const length = Math.hypot(...g) || 1;
    return [...[0, 1, 2].map((j) => -(A[0][j] * g[0] + A[1][j] * g[1] + A[2][j] * g[2]) / length), s];
  }

  // solid where the level is reached, and the rim of what lies around it
  function surface(A) {
    const [context, shown] = image(solid, fine), limit = (scene.high * level.value) / 100;
    rays(A, fine, (pixel, start, reach) => {
      const outer = meet(A, start, reach, Math.min(limit, 0.25 * scene.high));
      if (!outer) return;
      const rim = 0.75 * (1 - Math.min(1, Math.abs(outer[2]))) ** 2;
      const inner = meet(A, start, reach, limit);
      if (!inner) {
        shown.data.set([70, 110, 150, 255 * rim], 4 * pixel);
        return;
      }
      const [a, b, c, s] = inner;
      // light comes over the reader's left shoulder
      const light = Math.max(0, -0.45 * a - 0.5 * b - 0.74 * c), shine = 50 * light ** 24;
      const bright = (0.22 + 0.78 * light) * (1 - (0.25 * (s + radius)) / (2 * radius));
      shown.data.set([92 * bright + shine, 150 * bright + shine, 205 * bright + shine, 255], 4 * pixel);
    });
    context.putImageData(shown, 0, 0);
  }

  // the rotation axis on both sides of the object; `front`: what lies before it
  function axis(context, omega, front) {
    if (!omega || !Math.hypot(...omega)) return;
    const length = Math.hypot(...omega);
    const [x, y, z] = [0, 1, 2].map((j) => (view[0][j] * omega[0] + view[1][j] * omega[1] + view[2][j] * omega[2]) / length);
    for (const sign of [-1, 1]) {
      if (sign * z < 0 !== front) continue;
      context.strokeStyle = "#e0831a";
      context.lineWidth = 4;
      context.lineCap = "round";
      context.beginPath();
      const from = 0.62 * front, to = 0.97;
      context.moveTo((edge / 2) * (1 + sign * from * x), (edge / 2) * (1 + sign * from * y));
      context.lineTo((edge / 2) * (1 + sign * to * x), (edge / 2) * (1 + sign * to * y));
      context.stroke();
    }
  }

  function frame(i) {
    const canvas = document.getElementById("film");
    if (!canvas) return;
    const [context, shown] = image(canvas, side), first = i * side * side;
    for (let j = 0; j < side * side; j += 1) {
      shown.data.fill(film[first + j], 4 * j, 4 * j + 3);
      shown.data[4 * j + 3] = 255;
    }
    context.putImageData(shown, 0, 0);
  }

  function drawShape() {
    const i = Number(slider.value), flat = scene.R[i];
    const R = [flat.slice(0, 3), flat.slice(3, 6), flat.slice(6, 9)];
    surface(times(R, view));
    shape.width = shape.height = edge;
    const context = shape.getContext("2d");
    axis(context, scene.omega[i], false);
    context.imageSmoothingQuality = "high";
    context.drawImage(solid, 0, 0, edge, edge);
    axis(context, scene.omega[i], true);
    return R;
  }

  function draw() {
    const i = Number(slider.value);
    frame(i);
    project(drawShape());
    const time = scene.timeUnit === "frame" ? "" : `t = ${scene.time[i]} ${scene.timeUnit}, `;
    document.getElementById("pose-at").textContent = `${time}frame ${scene.frame[i]}`;
  }

  let playing = 0;
  function play(on) {
    clearTimeout(playing);
    playing = on ? setTimeout(() => {
      slider.value = String((Number(slider.value) + 1) % scene.frame.length);
      draw();
      play(true);
    }, 50) : 0;
    button.textContent = on ? "Pause" : "Play";
  }

  button.addEventListener("click", () => play(!playing));
  slider.max = String(scene.frame.length - 1);
  slider.addEventListener("input", () => { play(false); draw(); });
  level.addEventListener("input", () => {
    document.getElementById("level-at").textContent = `${level.value} %`;
    drawShape();
  });
  turnable(shape, edge, (dx, dy) => {
    // the view takes the screen to the laboratory
    view = times(view, times(turnY(dx / grip), turnX(-dy / grip)));
    drawShape();
  });
  shape.addEventListener("dblclick", () => { view = unmoved; drawShape(); });
  draw();
  document.getElementById("turning").dataset.ready = "yes";
})();
