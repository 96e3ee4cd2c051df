/* The wiring of the bench, and its description for the host. Change this file for another bench. */
#ifndef CARTLAB_BOARD_H
#define CARTLAB_BOARD_H

#define NAME "cartlab"
#define ENCODERS 2 /* two or three */
#define CARTS 2    /* the first encoders; any further one has no cart */

/* The size of a duty count and of an encoder count: a number and its unit without a space. */
#define INPUT_PER_COUNT "0.001220703125V" /* 5 V / 4096 */
#define POSITION_PER_COUNT "1.0count"

#if defined(__AVR_ATmega2560__)

/* Arduino Mega 2560. Its six interrupt pins are enough for three encoders. 115200 baud can carry
 * 250 lines a second of any length; at 500000 baud the period may be 0.0025. */
#define BAUD 115200
#define PERIOD 0.004 /* s */
static const uint8_t ENCODER_PINS[][2] = {{2, 3}, {18, 19}, {20, 21}}; /* channels A, B */
#define MOTOR_PWM 6 /* timer 4, channel A: motor.h sets its registers */
#define MOTOR_DIRECTION 7

#else

/* Teensy 3.x and 4.x, and other 32-bit boards on which every pin can interrupt. USB has no baud
 * rate; the host opens its port with this number. */
#define BAUD 115200
#define PERIOD 0.001 /* s */
static const uint8_t ENCODER_PINS[][2] = {{0, 1}, {2, 3}, {4, 5}}; /* channels A, B */
#define MOTOR_PWM 9
#define MOTOR_DIRECTION 10
/* For an amplifier that takes a voltage, define MOTOR_DAC as a pin with a converter (Teensy 3.2:
 * A14) and have a level shifter turn its 0 ... 3.3 V into -5 ... 5 V. */

#endif

#endif
