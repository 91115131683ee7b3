// Amplitude density of a record by a Hann window and a fast Fourier transform, in the record's unit per root hertz.

export function spectrum(values, periodS) {
  const n = 1 << Math.floor(Math.log2(values.length));
  const re = new Float64Array(n), im = new Float64Array(n);
  const offset = values.length - n;
  let mean = 0, power = 0;
  for (let i = 0; i < n; i++) mean += values[offset + i] / n;
  for (let i = 0; i < n; i++) {
    const w = 0.5 - 0.5 * Math.cos((2 * Math.PI * i) / n);
    power += w * w;
    re[i] = (values[offset + i] - mean) * w;
  }
  transform(re, im);
  const half = n >> 1, hz = new Float64Array(half - 1), density = new Float64Array(half - 1);
  for (let k = 1; k < half; k++) {
    hz[k - 1] = k / (n * periodS);
    density[k - 1] = Math.sqrt((2 * (re[k] * re[k] + im[k] * im[k]) * periodS) / power);
  }
  return [hz, density];
}

function transform(re, im) {
  const n = re.length;
  for (let i = 1, j = 0; i < n; i++) {
    let bit = n >> 1;
    for (; j & bit; bit >>= 1) j ^= bit;
    j ^= bit;
    if (i < j) { [re[i], re[j]] = [re[j], re[i]]; [im[i], im[j]] = [im[j], im[i]]; }
  }
  for (let size = 2; size <= n; size <<= 1) {
    const turn = (-2 * Math.PI) / size;
    for (let begin = 0; begin < n; begin += size) {
      for (let k = 0; k < size / 2; k++) {
        const c = Math.cos(turn * k), s = Math.sin(turn * k), a = begin + k, b = a + size / 2;
        const x = re[b] * c - im[b] * s, y = re[b] * s + im[b] * c;
        re[b] = re[a] - x; im[b] = im[a] - y; re[a] += x; im[a] += y;
      }
    }
  }
}
