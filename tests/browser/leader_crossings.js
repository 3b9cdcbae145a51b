async () => {
  const { LabelLayout } = await import("/static/scene/layout.js");
  const side = ([x0, y0, x1, y1], x, y) => (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0);
  const parts = (a, b) => side(a, b[0], b[1]) * side(a, b[2], b[3]) < 0;
  const cross = (a, b) => parts(a, b) && parts(b, a);
  let seed = 1, counts = { first: 0, last: 0, labels: 0 };
  const random = () => (seed = (seed * 16807) % 2147483647) / 2147483647;
  for (let trial = 0; trial < 40; trial++) {
    const layout = new LabelLayout(), area = { left: 0, top: 0, width: 1000, height: 640 };
    const requests = Array.from({ length: 12 }, (_, i) => (
      { key: `k${i}`, width: 150, height: 34 + 16 * (i % 2), x: 350 + 300 * random(), y: 120 + 400 * random() }));
    for (let call = 0; call < 80; call++) {
      const placed = layout.place(area, requests, { left: 340, right: 660 }, () => 0, true);
      const lines = placed.map((one) => {
        const request = requests.find(({ key }) => key === one.key);
        return [one.side === "left" ? one.left + request.width : one.left, one.top + 17, request.x, request.y];
      });
      const crossings = lines.flatMap((a, i) => lines.slice(i + 1).filter((b) => cross(a, b))).length;
      if (call === 0) counts.first += crossings;
      if (call === 79) { counts.last += crossings; counts.labels += placed.length; }
    }
  }
  return counts;
}
