/* Output of duty counts to the amplifier. */
#ifndef CARTLAB_MOTOR_H
#define CARTLAB_MOTOR_H

#if defined(MOTOR_DAC)

/* A voltage around the middle of the converter's 12 bits; its top is a step short of full scale. */
static void motor_drive(int16_t duty) { analogWrite(MOTOR_DAC, min(2048 + duty / 2, 4095)); }

static void motor_begin()
{
    analogWriteResolution(12);
    motor_drive(0);
}

#elif defined(__AVR_ATmega2560__)

/* analogWrite has 8 bits here. Timer 4 counts to 4095 instead, 3906 times a second, and holds the
 * pin high for OCR4A + 1 of its counts; no duty at all takes the pin from the timer. */
static void motor_drive(int16_t duty)
{
    const uint16_t size = duty < 0 ? -duty : duty;
    digitalWrite(MOTOR_DIRECTION, duty < 0);
    if (size == 0) {
        TCCR4A &= ~_BV(COM4A1);
    } else {
        OCR4A = size - 1;
        TCCR4A |= _BV(COM4A1);
    }
}

static void motor_begin()
{
    pinMode(MOTOR_PWM, OUTPUT);
    pinMode(MOTOR_DIRECTION, OUTPUT);
    ICR4 = FULL_SCALE - 1;
    TCCR4A = _BV(WGM41);                          /* fast PWM up to ICR4 ... */
    TCCR4B = _BV(WGM43) | _BV(WGM42) | _BV(CS40); /* ... at the processor's clock rate */
    motor_drive(0);
}

#else

static void motor_drive(int16_t duty)
{
    digitalWrite(MOTOR_DIRECTION, duty < 0);
    analogWrite(MOTOR_PWM, abs(duty));
}

static void motor_begin()
{
    pinMode(MOTOR_PWM, OUTPUT);
    pinMode(MOTOR_DIRECTION, OUTPUT);
    analogWriteResolution(12);
#if defined(TEENSYDUINO)
    analogWriteFrequency(MOTOR_PWM, 10000); /* Hz; the default may be as low as 488 */
#endif
    motor_drive(0);
}

#endif

#endif
