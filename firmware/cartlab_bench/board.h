/* What is wired where, and what the bench says of itself: the file to change for another bench. */
#ifndef CARTLAB_BOARD_H
#define CARTLAB_BOARD_H

#define NAME "cartlab"
#define ENCODERS 2 /* two or three */
#define CARTS 2    /* so many of the encoders are carts */

/* What a duty count and an encoder count are worth, a number and its unit without a space. */
#define INPUT_PER_COUNT "0.001220703125V" /* 5 V / 4096 */
#define POSITION_PER_COUNT "1.0count"

#if defined(__AVR_ATmega2560__)

/* Arduino Mega 2560. Its six interrupt pins take three encoders. 115200 baud carry 250 lines a
 * second however long they are; at 500000 baud the period may be 0.0025. */
#define BAUD 115200
#define PERIOD 0.004 /* s */
static const uint8_t ENCODER_PINS[][2] = {{2, 3}, {18, 19}, {20, 21}}; /* channels A, B */
#define MOTOR_PWM 6 /* timer 4, channel A: motor.h sets its registers */
#define MOTOR_DIRECTION 7

#else

/* Teensy 3.x and 4.x, and other boards of 32 bits whose every pin may interrupt. USB has no baud:
 * the number is what the host opens its port with. */
#define BAUD 115200
#define PERIOD 0.001 /* s */
static const uint8_t ENCODER_PINS[][2] = {{0, 1}, {2, 3}, {4, 5}}; /* channels A, B */
#define MOTOR_PWM 9
#define MOTOR_DIRECTION 10
/* For an amplifier that takes a voltage, define MOTOR_DAC as a pin with a converter (Teensy 3.2:
 * A14) and have a level shifter turn its 0 ... 3.3 V into -5 ... 5 V. */

#endif

#endif
