/* The closed loop of the SCARA (Brunot et al. 2016) by RK4, and its 8 sensitivities by dual numbers.

   What a careful programmer would write by hand: the limit that the benchmark compares with.
   cc -O3 -march=native -ffast-math -shared -fPIC scara.c -lm */

#include <math.h>
#include <string.h>

#define P 8
enum { ZZ1R, ZZ2, MX2, MY2, FV1, FC1, FV2, FC2 };

static const double KP[2] = {6.25, 156.25}, KV[2] = {2.0, 25.0}, KG[2] = {3.5, 0.06};
static const double GAMMA = 100.0, LENGTH = 0.5;

/* --- plain numbers ------------------------------------------------------------------------- */

static inline void command(const double c[8], double t, const double x[4], double tau[2]) {
  for (int j = 0; j < 2; j++) {
    double reference = c[j] + t * (c[2 + j] + t * (c[4 + j] + t * c[6 + j]));
    tau[j] = KG[j] * (KP[j] * (reference - x[j]) - KV[j] * x[2 + j]);
  }
}

static inline void rate(const double p[P], const double c[8], double t, const double x[4],
                        double dx[4]) {
  double tau[2], v1 = x[2], v2 = x[3], cs = cos(x[1]), sn = sin(x[1]);
  command(c, t, x, tau);
  double coupling = LENGTH * (p[MX2] * cs - p[MY2] * sn);
  double moment = LENGTH * (p[MX2] * sn + p[MY2] * cs);
  double m11 = p[ZZ1R] + p[ZZ2] + 2 * coupling, m12 = p[ZZ2] + coupling, m22 = p[ZZ2];
  double b1 = tau[0] - p[FV1] * v1 - p[FC1] * M_2_PI * atan(GAMMA * v1) + moment * v2 * (2 * v1 + v2);
  double b2 = tau[1] - p[FV2] * v2 - p[FC2] * M_2_PI * atan(GAMMA * v2) - moment * v1 * v1;
  double inverse = 1 / (m11 * m22 - m12 * m12);
  dx[0] = v1;
  dx[1] = v2;
  dx[2] = (m22 * b1 - m12 * b2) * inverse;
  dx[3] = (m11 * b2 - m12 * b1) * inverse;
}

static inline void along(const double x[4], const double k[4], double h, double y[4]) {
  for (int i = 0; i < 4; i++) y[i] = x[i] + h * k[i];
}

/* Torque at every point, (points, 2); coefficients (points, 4, 2). */
void simulate(int points, int substeps, const double *lengths, const double *coefficients,
              const double *p, const double *start, double *tau) {
  double x[4], y[4], k1[4], k2[4], k3[4], k4[4];
  memcpy(x, start, sizeof x);
  for (int n = 0; n < points; n++) {
    const double *c = coefficients + 8 * n;
    double h = lengths[n] / substeps;
    command(c, 0.0, x, tau + 2 * n);
    for (int s = 0; s < substeps; s++) {
      double t = s * h;
      rate(p, c, t, x, k1);
      along(x, k1, h / 2, y);
      rate(p, c, t + h / 2, y, k2);
      along(x, k2, h / 2, y);
      rate(p, c, t + h / 2, y, k3);
      along(x, k3, h, y);
      rate(p, c, t + h, y, k4);
      for (int i = 0; i < 4; i++) x[i] += h / 6 * (k1[i] + 2 * (k2[i] + k3[i]) + k4[i]);
    }
  }
}

/* --- dual numbers -------------------------------------------------------------------------- */

typedef struct {
  double v;
  double d[P];
} Dual;

#define EACH for (int i = 0; i < P; i++)

static inline Dual add(Dual a, Dual b) { Dual r; r.v = a.v + b.v; EACH r.d[i] = a.d[i] + b.d[i]; return r; }
static inline Dual sub(Dual a, Dual b) { Dual r; r.v = a.v - b.v; EACH r.d[i] = a.d[i] - b.d[i]; return r; }
static inline Dual scale(double s, Dual a) { Dual r; r.v = s * a.v; EACH r.d[i] = s * a.d[i]; return r; }
static inline Dual mul(Dual a, Dual b) { Dual r; r.v = a.v * b.v; EACH r.d[i] = a.v * b.d[i] + b.v * a.d[i]; return r; }
static inline Dual chain(double v, double slope, Dual a) { Dual r; r.v = v; EACH r.d[i] = slope * a.d[i]; return r; }
static inline Dual inverse_of(Dual a) { double v = 1 / a.v; return chain(v, -v * v, a); }

static inline void command_d(const double c[8], double t, const Dual x[4], Dual tau[2]) {
  for (int j = 0; j < 2; j++) {
    double reference = c[j] + t * (c[2 + j] + t * (c[4 + j] + t * c[6 + j]));
    tau[j].v = KG[j] * (KP[j] * (reference - x[j].v) - KV[j] * x[2 + j].v);
    EACH tau[j].d[i] = -KG[j] * (KP[j] * x[j].d[i] + KV[j] * x[2 + j].d[i]);
  }
}

static inline Dual smooth_sign(Dual v) {
  double g = GAMMA * v.v;
  return chain(M_2_PI * atan(g), M_2_PI * GAMMA / (1 + g * g), v);
}

static inline void rate_d(const Dual p[P], const double c[8], double t, const Dual x[4], Dual dx[4]) {
  Dual tau[2], v1 = x[2], v2 = x[3];
  double cv = cos(x[1].v), sv = sin(x[1].v);
  Dual cs = chain(cv, -sv, x[1]), sn = chain(sv, cv, x[1]);
  command_d(c, t, x, tau);
  Dual coupling = scale(LENGTH, sub(mul(p[MX2], cs), mul(p[MY2], sn)));
  Dual moment = scale(LENGTH, add(mul(p[MX2], sn), mul(p[MY2], cs)));
  Dual m11 = add(add(p[ZZ1R], p[ZZ2]), scale(2, coupling)), m12 = add(p[ZZ2], coupling), m22 = p[ZZ2];
  Dual b1 = sub(sub(tau[0], mul(p[FV1], v1)), mul(p[FC1], smooth_sign(v1)));
  b1 = add(b1, mul(mul(moment, v2), add(scale(2, v1), v2)));
  Dual b2 = sub(sub(tau[1], mul(p[FV2], v2)), mul(p[FC2], smooth_sign(v2)));
  b2 = sub(b2, mul(moment, mul(v1, v1)));
  Dual inverse = inverse_of(sub(mul(m11, m22), mul(m12, m12)));
  dx[0] = v1;
  dx[1] = v2;
  dx[2] = mul(sub(mul(m22, b1), mul(m12, b2)), inverse);
  dx[3] = mul(sub(mul(m11, b2), mul(m12, b1)), inverse);
}

static inline void along_d(const Dual x[4], const Dual k[4], double h, Dual y[4]) {
  for (int j = 0; j < 4; j++) y[j] = add(x[j], scale(h, k[j]));
}

/* Torque, (points, 2), and its derivatives by the parameters, (points, 2, 8). */
void jacobian(int points, int substeps, const double *lengths, const double *coefficients,
              const double *values, const double *start, double *tau, double *slopes) {
  Dual p[P], x[4], y[4], k1[4], k2[4], k3[4], k4[4], out[2];
  memset(p, 0, sizeof p);
  memset(x, 0, sizeof x);
  for (int i = 0; i < P; i++) p[i].v = values[i], p[i].d[i] = 1;
  for (int i = 0; i < 4; i++) x[i].v = start[i];
  for (int n = 0; n < points; n++) {
    const double *c = coefficients + 8 * n;
    double h = lengths[n] / substeps;
    command_d(c, 0.0, x, out);
    for (int j = 0; j < 2; j++) {
      tau[2 * n + j] = out[j].v;
      memcpy(slopes + P * (2 * n + j), out[j].d, sizeof out[j].d);
    }
    for (int s = 0; s < substeps; s++) {
      double t = s * h;
      rate_d(p, c, t, x, k1);
      along_d(x, k1, h / 2, y);
      rate_d(p, c, t + h / 2, y, k2);
      along_d(x, k2, h / 2, y);
      rate_d(p, c, t + h / 2, y, k3);
      along_d(x, k3, h, y);
      rate_d(p, c, t + h, y, k4);
      for (int j = 0; j < 4; j++) {
        x[j].v += h / 6 * (k1[j].v + 2 * (k2[j].v + k3[j].v) + k4[j].v);
        EACH x[j].d[i] += h / 6 * (k1[j].d[i] + 2 * (k2[j].d[i] + k3[j].d[i]) + k4[j].d[i]);
      }
    }
  }
}
