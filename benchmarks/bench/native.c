/* The native loops, for packets of W rays: see casting.py. */
#include <math.h>
#include <stdint.h>
typedef void (*trace_t)(const int *, void *, void *, void *);
#define NONE 0xFFFFFFFFu
struct packet {
  float ox[W], oy[W], oz[W], near[W], dx[W], dy[W], dz[W], time[W], far[W];
  uint32_t mask[W], id[W], flags[W];
  float ng[3][W], uv[2][W];
  uint32_t prim[W], geom[W], inst[W], place[W];
};
struct rays {
  double ox[W], oy[W], oz[W], dx[W], dy[W], dz[W];
};
static inline void gather(const double *position, const double *rotation, const int64_t *pose,
                          const double *dirs, const double *origin, long b, int m, int *valid,
                          struct packet *p, struct rays *r) {
  for (int k = 0; k < W; k++) {
    long i = k < m ? b + k : b;
    const double *R = rotation + 9 * pose[i], *o = position + 3 * pose[i], *d = dirs + 3 * i;
    valid[k] = k < m ? -1 : 0;
    r->ox[k] = o[0] - origin[0]; r->oy[k] = o[1] - origin[1]; r->oz[k] = o[2] - origin[2];
    r->dx[k] = R[0] * d[0] + R[1] * d[1] + R[2] * d[2];
    r->dy[k] = R[3] * d[0] + R[4] * d[1] + R[5] * d[2];
    r->dz[k] = R[6] * d[0] + R[7] * d[1] + R[8] * d[2];
    p->ox[k] = r->ox[k]; p->oy[k] = r->oy[k]; p->oz[k] = r->oz[k];
    p->dx[k] = r->dx[k]; p->dy[k] = r->dy[k]; p->dz[k] = r->dz[k];
    p->near[k] = 0; p->far[k] = INFINITY; p->time[k] = 0;
    p->mask[k] = 0xFFFFFFFFu; p->id[k] = k; p->flags[k] = 0;
    p->geom[k] = p->inst[k] = p->place[k] = NONE;
  }
}
void cast(trace_t trace, void *scene, void *args, const double *position, const double *rotation,
          const int64_t *pose, const double *dirs, const double *origin, long lo, long hi,
          float *t, uint32_t *prim) {
  struct packet p __attribute__((aligned(64)));
  struct rays r __attribute__((aligned(64)));
  int valid[W] __attribute__((aligned(64)));
  for (long b = lo; b < hi; b += W) {
    int m = hi - b < W ? (int)(hi - b) : W;
    gather(position, rotation, pose, dirs, origin, b, m, valid, &p, &r);
    trace(valid, scene, &p, args);
    for (int k = 0; k < m; k++) {
      t[b + k] = p.far[k];
      prim[b + k] = p.geom[k] == NONE ? NONE : p.prim[k];
    }
  }
}
/* Ranges and cosines in float64 from planes (n, 5): normal, offset, margin. */
void cast_planes(trace_t trace, void *scene, void *args, const double *position, const double *rotation,
                 const int64_t *pose, const double *dirs, const double *origin, long lo, long hi,
                 double *t, int32_t *prim, int32_t *instance, float *cosine, const double *planes) {
  struct packet p __attribute__((aligned(64)));
  struct rays r __attribute__((aligned(64)));
  int valid[W] __attribute__((aligned(64)));
  for (long b = lo; b < hi; b += W) {
    int m = hi - b < W ? (int)(hi - b) : W;
    gather(position, rotation, pose, dirs, origin, b, m, valid, &p, &r);
    trace(valid, scene, &p, args);
    for (int k = 0; k < m; k++) {
      int hit = p.geom[k] != NONE;
      const double *n = planes + 5 * (long)(hit ? p.prim[k] : 0);
      double along = n[0] * r.dx[k] + n[1] * r.dy[k] + n[2] * r.dz[k];
      double range = (n[3] - n[0] * r.ox[k] - n[1] * r.oy[k] - n[2] * r.oz[k]) / along;
      t[b + k] = hit ? range : INFINITY;
      cosine[b + k] = hit ? -along : 0;
      prim[b + k] = hit ? (int32_t)p.prim[k] : -1;
      instance[b + k] = -1;
    }
  }
}
