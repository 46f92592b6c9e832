/* The native loop: see casting.py. */
#include <math.h>
#include <stdint.h>
typedef void (*trace_t)(const int *, void *, void *, void *);
#define W 16
struct packet {
  float ox[W], oy[W], oz[W], near[W], dx[W], dy[W], dz[W], time[W], far[W];
  uint32_t mask[W], id[W], flags[W];
  float ng[3][W], uv[2][W];
  uint32_t prim[W], geom[W], inst[W], place[W];
};
void cast(trace_t trace, void *scene, void *args, const double *position, const double *rotation,
          const int64_t *pose, const double *dirs, const double *origin, long lo, long hi,
          float *t, uint32_t *prim) {
  struct packet p __attribute__((aligned(64)));
  int valid[W] __attribute__((aligned(64)));
  for (long b = lo; b < hi; b += W) {
    int m = hi - b < W ? (int)(hi - b) : W;
    for (int k = 0; k < W; k++) {
      long i = k < m ? b + k : b;
      const double *R = rotation + 9 * pose[i], *o = position + 3 * pose[i], *d = dirs + 3 * i;
      valid[k] = k < m ? -1 : 0;
      p.ox[k] = o[0] - origin[0]; p.oy[k] = o[1] - origin[1]; p.oz[k] = o[2] - origin[2];
      p.dx[k] = R[0] * d[0] + R[1] * d[1] + R[2] * d[2];
      p.dy[k] = R[3] * d[0] + R[4] * d[1] + R[5] * d[2];
      p.dz[k] = R[6] * d[0] + R[7] * d[1] + R[8] * d[2];
      p.near[k] = 0; p.far[k] = INFINITY; p.time[k] = 0;
      p.mask[k] = 0xFFFFFFFFu; p.id[k] = k; p.flags[k] = 0;
      p.geom[k] = p.inst[k] = p.place[k] = 0xFFFFFFFFu;
    }
    trace(valid, scene, &p, args);
    for (int k = 0; k < m; k++) {
      t[b + k] = p.far[k];
      prim[b + k] = p.geom[k] == 0xFFFFFFFFu ? 0xFFFFFFFFu : p.prim[k];
    }
  }
}
